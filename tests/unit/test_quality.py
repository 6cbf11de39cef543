"""The quality benchmark on a small cloud: its rows are the product's own results, and it goes on where it stopped."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import plyfile
import pytest

pytest.importorskip("trimesh", reason="the benchmarks extra is not installed")

from benchmarks import parts, quality, subjects
from benchmarks.rates import patch_flops
from benchmarks.scenes import SCENES, Part, Scene
from benchmarks.subjects import (
    COLUMNS,
    Column,
    Subject,
    at_points,
    load_clouds,
    load_meshes,
    load_printed,
    load_shapes,
)
from pointfilter import Engine, PointCloud, filter_cloud
from pointfilter.adaptive.calibration import Calibration
from pointfilter.metrics import point_to_surface
from pointfilter.models import load_bundle
from pointfilter.network import Answers
from pointfilter.noise import add_noise
from tests.clouds import crease

COARSE, FINE = 0.02, 0.005


def write_mesh(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    rows = np.array([tuple(row) for row in vertices], dtype=[(name, "f8") for name in "xyz"])
    lists = np.array([(row,) for row in faces.tolist()], dtype=[("vertex_indices", "i4", (3,))])
    elements = [plyfile.PlyElement.describe(rows, "vertex"), plyfile.PlyElement.describe(lists, "face")]
    plyfile.PlyData(elements).write(str(path))


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """One crease: two squares that meet in a right angle along the y axis, as tests.clouds makes them."""
    rng = np.random.default_rng(0)
    clean = crease(700, rng, angle=np.pi / 2)
    (tmp_path / "paper4" / "mesh").mkdir(parents=True)
    np.save(tmp_path / "paper4" / "crease.npy", clean)
    np.save(tmp_path / "paper4" / f"crease_{FINE}.npy", add_noise(clean, FINE, rng).astype(np.float32))
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [0, 1, 1]], dtype=np.float64)
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 5, 4], [0, 3, 5]])
    write_mesh(tmp_path / "paper4" / "mesh" / "surface.ply", corners, faces)
    for folder, names in (("meshes", ["angle"]), ("shapes", ["angle", "lion"]), ("printed", ["angle_truth"])):
        (tmp_path / folder).mkdir()
        for name in names:
            write_mesh(tmp_path / folder / f"{name}.ply", corners, faces)
    PointCloud(add_noise(clean, FINE, rng)).write(tmp_path / "printed" / "angle_scan.ply")
    return tmp_path


@pytest.fixture
def subject(data: Path) -> Subject:
    (found,) = load_clouds(data / "paper4")
    return found


def test_the_surface_fits_the_clean_cloud_and_has_one_sharp_edge(subject: Subject) -> None:
    scores = subject.scores(subject.clean, subject.clean)
    assert scores["cd"] == 0
    assert scores["p2f"] < 1e-6
    edges = subject.sharp_edges
    np.testing.assert_allclose(edges[:, [0, 2]], 0, atol=1e-12)
    assert (edges[:, 1].min(), edges[:, 1].max()) == (0, 1)
    assert np.diff(np.sort(edges[:, 1])).max() < 0.001


def test_points_close_to_the_edge_are_told_apart(subject: Subject) -> None:
    """A cloud moved along z by h: the upright square stays on the surface, the lying one is h off."""
    moved = subject.clean + np.array([0, 0, 0.001])
    diagonal = np.linalg.norm(np.ptp(subject.clean, axis=0))
    lying = subject.clean[:, 2] < 1e-9
    scores = subject.scores(subject.clean, moved)
    assert scores["p2f"] == pytest.approx(1e3 * 0.001 * lying.mean() / diagonal, rel=0.02)
    close = np.hypot(subject.clean[:, 0], subject.clean[:, 2]) < 0.01 * diagonal
    assert scores["edge"] == pytest.approx(1e3 * 0.001 * lying[close].mean() / diagonal, rel=0.25)


def test_columns_are_the_same_in_every_run_and_what_they_say(subject: Subject) -> None:
    for column in COLUMNS:
        clean, noisy = subject.clouds(column)
        again = subject.clouds(column)
        np.testing.assert_array_equal(noisy, again[1])
        assert clean.shape == noisy.shape
        assert (clean == noisy).all() == (column.level == 0)
    clean, noisy = subject.clouds(Column("few", COARSE, points=200))
    assert len(clean) == 200
    assert np.linalg.norm(noisy - clean, axis=1).mean() == pytest.approx(1.6 * COARSE * np.sqrt(3), rel=0.1)
    on_disk = np.load(next(iter(subject.noisy_files.values())))
    np.testing.assert_array_equal(subject.clouds(Column("0.5 %", FINE))[1], on_disk)
    thinned, _ = subject.clouds(Column("uneven", FINE, uneven=True))
    assert 0.3 * len(subject.clean) < len(thinned) < 0.8 * len(subject.clean)


def test_meshes_are_sampled(data: Path) -> None:
    (subject,) = load_meshes(data / "meshes", points=500)
    assert len(subject.clean) == 500
    assert subject.scores(subject.clean, subject.clean)["p2f"] < 1e-9


def test_shapes_are_sampled_more_densely(data: Path) -> None:
    angle, lion = load_shapes(data / "shapes")
    assert (angle.name, lion.name) == ("angle", "lion")
    assert len(angle.clean) == 400_000
    assert (angle.clean != lion.clean).any()
    columns = [column for column in COLUMNS if column.subjects == "shapes"]
    assert {"shapes clean", "shapes 2.5 %", "shapes 10 k 1 %", "shapes 400 k 0.5 %"} <= {c.name for c in columns}
    for column in columns:
        thousands = next((part for part in ("10 k", "400 k") if part in column.name), "100 k")
        assert len(lion.clouds(column)[1]) == 1000 * int(thousands.removesuffix(" k")), column.name


def test_columns_at_another_density_are_named_and_noisy_alike() -> None:
    columns = {column.name: column for column in COLUMNS}
    sparse = {column.name: column for column in at_points(COLUMNS, 10_000)}
    assert sparse["shapes 10 k 1 %"] == columns["shapes 10 k 1 %"]
    assert sparse["meshes 10 k 2.5 %"].level == 0.025
    assert {column.points for column in sparse.values()} == {10_000}
    assert len(sparse) == 12  # six levels of two sets
    dense = {column.name: column for column in at_points(COLUMNS, 100_000)}
    assert dense["shapes 1 %"] == columns["shapes 1 %"]


def test_a_printed_scan_is_measured_against_what_was_printed(data: Path) -> None:
    (subject,) = load_printed(data / "printed")
    assert subject.name == "angle"
    clean, noisy = subject.clouds(Column("printed", 0.001, subjects="printed"))
    np.testing.assert_array_equal(noisy, PointCloud.read(data / "printed" / "angle_scan.ply").xyz)
    diagonal = np.linalg.norm(np.ptp(clean, axis=0))
    expected = 1e3 * point_to_surface(noisy, subject.vertices, subject.faces).mean() / diagonal
    assert subject.scores(clean, noisy)["p2f"] == pytest.approx(expected, rel=1e-6)
    assert subject.scores(clean, clean)["p2f"] < 1e-9


def test_a_query_costs_what_the_layers_multiply() -> None:
    layers = {"encoder": [4, 6], "decoder": [5]}
    assert patch_flops(layers, 10) == 2 * (10 * (3 * 4 + 4 * 6) + 6 * 5 + 5 * 3)
    assert patch_flops({**layers, "adaptive": True}, 10) == 2 * (10 * (3 * 4 + 4 * 6) + (6 + 5) * 5 + 5 * 8)


def run(*arguments: object) -> int:
    return quality.main([str(argument) for argument in arguments])


def test_rows_are_what_the_product_does(data: Path, subject: Subject, bundle_folder: Path, engine: Engine) -> None:
    table = data / "table.json"
    options = ["--data", data, "--models", bundle_folder, "--classics", "--columns", "0.5 %", "--json", table]
    assert run(*options) == 0
    rows = {row["method"]: row for row in json.loads(table.read_text())["rows"]}
    clean, noisy = subject.clouds(Column("0.5 %", FINE))
    assert set(rows) == {"noisy", "limit", "tiny 1", "tiny 2", "tiny 4", "tiny auto"}
    for name, iterations in (("tiny 1", 1), ("tiny 2", 2), ("tiny 4", 4), ("tiny auto", None)):
        filtered, report = filter_cloud(PointCloud(noisy.copy()), engine, iterations=iterations)
        assert rows[name]["passes"] == report.iterations
        for figure, value in subject.scores(clean, filtered.xyz).items():
            assert rows[name][figure] == pytest.approx(value, rel=1e-4)
    assert rows["limit"]["p2f"] < 1e-9 < rows["noisy"]["p2f"]
    (mean,) = [row for row in json.loads(table.read_text())["means"] if row["method"] == "noisy"]
    assert mean["cd"] == rows["noisy"]["cd"]


def test_it_goes_on_where_it_stopped(
    data: Path, bundle_folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    table = data / "table.json"
    options = ["--data", data, "--classics", "--columns", "0.5 %", "impulsive 0.5 %", "--json", table]
    assert run(*options, "--models") == 0
    first = json.loads(table.read_text())["rows"]
    assert run(*options, "--models", bundle_folder) == 0
    second = json.loads(table.read_text())["rows"]
    assert second[: len(first)] == first
    assert len(second) == 3 * len(first)
    monkeypatch.setattr(quality, "filter_points", None)
    capsys.readouterr()
    assert run(*options, "--models", bundle_folder) == 0
    assert json.loads(table.read_text())["rows"] == second
    printed = capsys.readouterr().out
    assert "mean of 1" in printed
    rows, _, comparison = printed.partition("P2F by cell")
    assert rows.count("tiny auto") == 4
    assert "impulsive 0.5 %" in comparison


def test_other_lengths_of_patch_are_rows_of_their_own(data: Path, bundle_folder: Path, subject: Subject) -> None:
    table = data / "table.json"
    options = ["--data", data, "--models", bundle_folder, "--classics", "--columns", "0.5 %", "--json", table]
    assert run(*options, "--patch-points", 8) == 0
    rows = {row["method"]: row for row in json.loads(table.read_text())["rows"]}
    short = dataclasses.replace(load_bundle(bundle_folder), patch_points=8)
    clean, noisy = subject.clouds(Column("0.5 %", FINE))
    filtered, _ = filter_cloud(PointCloud(noisy.copy()), Engine(short), iterations=1)
    assert rows["tiny@8 1"]["cd"] == pytest.approx(subject.scores(clean, filtered.xyz)["cd"], rel=1e-4)
    assert rows["tiny@8 1"]["cd"] != rows["tiny 1"]["cd"]


@pytest.mark.parametrize("helping", [0, 1, 6])
def test_passes_that_the_filter_does_not_make_leave_the_rows_alike(helping: int, engine: Engine) -> None:
    """An adaptive network that expects to help in the first passes alone, and then says that it does not."""
    rng = np.random.default_rng(0)
    noisy = add_noise(crease(400, rng), FINE, rng)
    calibration = Calibration(
        balls=(24,), preference=0.0, still_weight=1.0, margin=0.0, passes=6, query_reach=0.0, error_factor=1.0
    )
    asked: list[int] = []

    class Network:
        bundle = dataclasses.replace(engine.bundle, calibration=calibration)
        threads = 1

        def __call__(self, _p: np.ndarray, told: np.ndarray, queries: np.ndarray, _o: np.ndarray) -> Answers:
            passes = sum(asked) // len(noisy) + 1  # the one that is being made, once the balls are chosen
            asked.append(len(queries) if told[0, 1] else 0)
            helps = helping > 0 and (not told[0, 1] or passes < helping)
            errors = np.tile(np.float32([-3, -2] if helps else [-2, -3]), (len(queries), 1))
            return Answers(np.full((len(queries), 3), 0.01, np.float32), errors)

    rows, result = quality._filtered(noisy, Network())  # type: ignore[arg-type]
    assert result.points is rows["auto"][0]
    made = {"1": 1, "2": 2, "4": 4, "auto": 6}
    most = min(helping + 1, 6) if helping else 0  # one more to see that it does not help
    assert {name: passes for name, (_, _, passes) in rows.items()} == {
        name: min(passes, most) for name, passes in made.items()
    }
    for name, (points, seconds, passes) in rows.items():
        moved = np.linalg.norm(points - noisy, axis=1)
        assert seconds > 0
        assert (moved.max() > 0) == (helping > 0)
        assert (points == rows["auto"][0]).all() == (min(passes, helping) == min(6, helping)), name


def test_clouds_may_be_named(data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subjects, "SHAPE_POINTS", 12_000)
    table = data / "table.json"
    options = ["--data", data, "--models", "--classics", "--json", table, "--columns", "0.5 %", "shapes 10 k 1 %"]
    options += ["shapes 400 k 0.5 %", "printed"]
    measured = {
        ("lion",): {("shapes 10 k 1 %", "lion"), ("shapes 400 k 0.5 %", "lion")},
        ("angle",): {("shapes 10 k 1 %", "angle"), ("printed", "angle")},  # the densest column is not for all shapes
        ("crease", "tp"): {("0.5 %", "crease")},
    }
    for names, expected in measured.items():
        table.unlink(missing_ok=True)
        assert run(*options, "--clouds", *names) == 0
        rows = json.loads(table.read_text())["rows"]
        assert {(row["column"], row["cloud"]) for row in rows} == expected
        assert {row["method"] for row in rows} == {"noisy", "limit"}
    capsys.readouterr()
    assert run(*options, "--clouds", "tp") == 2
    assert "no benchmark data of tp" in capsys.readouterr().err


def test_without_data_it_says_what_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--data", tmp_path, "--set", "shapes") == 2
    said = capsys.readouterr().err
    assert "POINTFILTER_BENCHMARK_DATA" in said
    assert f"left out: the set shapes: no folder shapes/ in {tmp_path}" in said


def test_sets_points_and_scenes_may_be_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    def chosen(*arguments: str) -> tuple[set[str], list[str]]:
        options = quality._parser().parse_args(list(arguments))
        return {column.subjects for column in quality._columns(options)}, quality._scenes(options)

    everything = {"paper", "meshes", "shapes", "printed"}
    assert chosen() == (everything, list(SCENES))
    assert chosen("--set", "scenes") == (set(), list(SCENES))
    assert chosen("--set", "scenes", "printed", "--clouds", "room") == ({"printed"}, ["room"])
    assert chosen("--columns", "printed") == ({"printed"}, [])
    assert chosen("--points", "5000") == ({"meshes", "shapes"}, [])
    assert chosen("--points", "5000", "--set", "meshes") == ({"meshes"}, [])
    assert chosen("--points", "5000", "--columns", "shapes 5 k 1 %") == ({"shapes"}, [])
    with pytest.raises(SystemExit):
        chosen("--points", "1000000")
    for unknown in (["--columns", "shapes 5 k 1 %"], ["--points", "5000", "--columns", "shapes 1 %"]):
        with pytest.raises(SystemExit):
            quality.main(unknown)


def test_scenes_are_measured_once_and_printed(
    data: Path, bundle_folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(0)
    clean = rng.random((300, 3)) * [1, 1, 0]
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float64)
    flat = Part("flat", corners, np.array([[0, 1, 2], [0, 2, 3]]))
    noisy = clean + rng.normal(scale=0.01, size=clean.shape)
    monkeypatch.setitem(SCENES, "room", lambda: Scene("room", "mm", (flat,), clean, noisy, np.zeros(300, np.int64)))
    table = data / "table.json"
    options = ["--models", bundle_folder, "--classics", "--set", "scenes", "--clouds", "room", "--json", table]
    assert run(*options) == 0
    (row,) = json.loads(table.read_text())["scenes"]
    assert (row["scene"], row["part"], row["method"], row["points"]) == ("room", "flat", "tiny", 300)
    height = noisy[:, 2] ** 2 + np.square(noisy[:, :2] - np.clip(noisy[:, :2], 0, 1)).sum(axis=1)
    assert row["before"] == pytest.approx(1000 * np.sqrt(height.mean()))
    monkeypatch.setattr(parts, "filter_points", None)
    capsys.readouterr()
    assert run(*options) == 0
    printed = capsys.readouterr().out
    assert printed.count("flat") == 1
    assert f"{row['after']:.4f}" in printed
