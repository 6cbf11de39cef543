"""Columns that the filter writes beside x, y and z."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pointfilter import Engine, PointCloud, Radius, filter_cloud
from pointfilter.attributes import parse_columns, signed
from pointfilter.errors import ParameterError
from pointfilter.filter import filter_points
from tests.ply_files import ORDERS, Column, Table, write_ply

ENCODINGS = ["ascii", *ORDERS]
NORMALS = ("nx", "ny", "nz")


def scan(
    folder: Path,
    points: np.ndarray,
    encoding: str = "ascii",
    kind: str = "double",
    lists: bool = False,
    normals: np.ndarray | None = None,
    newline: bytes = b"\n",
) -> Path:
    """A file of points (n, 3) with colours, perhaps normals, a column of lists, another element and faces."""
    layout = [Column("red", "uchar"), *(Column(axis, kind) for axis in "xyz")]
    rows = [[k % 256, *map(float, row)] for k, row in enumerate(points)]
    if lists:
        layout.insert(2, Column("views", "short", "uchar"))
        rows = [[*row[:2], [-k] * (k % 3), *row[2:]] for k, row in enumerate(rows)]
    if normals is not None:
        layout[1:1] = [Column("nx", kind)]
        layout += [Column("ny", kind), Column("w", "short"), Column("nz", kind)]
        rows = [
            [row[0], float(n[0]), *row[1:], float(n[1]), k, float(n[2])]
            for k, (row, n) in enumerate(zip(rows, normals, strict=True))
        ]
    tables = [
        Table("camera", [Column("nx", "float")], [[0.5]]),
        Table("vertex", layout, rows),
        Table("face", [Column("vertex_indices", "int", "uchar")], [[[0, 1, 2]]]),
    ]
    path = folder / "scan.ply"
    path.write_bytes(write_ply(encoding, tables, newline=newline, remarks={3: [b"comment kept"]}).data)
    return path


def through(cloud: PointCloud, folder: Path, encoding: str = "same") -> PointCloud:
    cloud.write(folder / "out.ply", encoding)
    return PointCloud.read(folder / "out.ply")


# --- columns of a cloud ---


@pytest.mark.parametrize("newline", [b"\n", b"\r\n"], ids=["lf", "crlf"])
@pytest.mark.parametrize("lists", [False, True], ids=["numbers", "lists"])
@pytest.mark.parametrize("kind", ["float", "double"])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_columns_are_set_added_and_dropped(
    encoding: str, kind: str, lists: bool, newline: bytes, tmp_path: Path
) -> None:
    points, normals = np.random.default_rng(0).normal(size=(2, 20, 3)).astype(np.float32).astype(float)
    cloud = PointCloud.read(scan(tmp_path, points, encoding, kind, lists, normals, newline))
    assert cloud.source is not None
    np.testing.assert_array_equal(cloud.column_values(NORMALS), normals)
    new = np.arange(20) / 8
    new[3] = np.nan
    edited = cloud.with_columns({"nz": new, "scalar_a": new}).without_columns(["red", "views", "nx", "nothing"])
    kept = np.where(np.isfinite(new), new, normals[:, 2])  # NaN leaves a column of the file as it is
    for again in (
        edited,
        through(edited, tmp_path),
        through(edited, tmp_path, "ascii"),
        through(edited, tmp_path, "binary_big_endian"),
    ):
        assert list(again.column_types) == ["x", "y", "z", "ny", "w", "nz", "scalar_a"]
        np.testing.assert_array_equal(again.xyz, points)
        np.testing.assert_array_equal(
            again.column_values(("scalar_a", "ny", "nz")), np.column_stack([new, normals[:, 1], kept])
        )
    found = through(edited, tmp_path).source
    assert found is not None
    rest = [found.summary["elements"][name] for name in ("camera", "face")]
    assert rest == [cloud.source.summary["elements"][name] for name in ("camera", "face")]
    assert found.summary["comments"] == ["kept"]
    assert (tmp_path / "out.ply").read_bytes().endswith((tmp_path / "scan.ply").read_bytes()[-10:])
    assert (tmp_path / "out.ply").read_bytes().count(newline) > 10
    same = cloud.without_columns(["w"]).with_columns({"w2": new}).without_columns(["w2"])
    assert list(same.column_types) == [name for name in cloud.column_types if name != "w"]
    unchanged = cloud.with_columns({"nx": np.full(20, np.nan)})
    unchanged.write(tmp_path / "same.ply")
    assert (tmp_path / "same.ply").read_bytes() == (tmp_path / "scan.ply").read_bytes()


def test_a_cloud_of_arrays_may_have_columns(tmp_path: Path) -> None:
    cloud = PointCloud(np.eye(3)).with_columns({"a": np.array([1.0, np.nan, 0.1])})
    np.testing.assert_array_equal(cloud.column_values(["a"])[:, 0], [1.0, np.nan, 0.1])
    np.testing.assert_array_equal(through(cloud, tmp_path).column_values(["a"])[:, 0], np.float32([1.0, np.nan, 0.1]))
    with pytest.raises(KeyError):
        cloud.column_values(["b"])


def test_columns_that_cannot_be(tmp_path: Path) -> None:
    cloud = PointCloud.read(scan(tmp_path, np.eye(3), lists=True))
    with pytest.raises(ValueError, match="one ASCII word"):
        cloud.with_columns({"two words": np.zeros(3)})
    with pytest.raises(ValueError, match=r"\(3,\)"):
        cloud.with_columns({"a": np.zeros(4)})
    with pytest.raises(ValueError, match="cannot be dropped"):
        cloud.without_columns(["x"])
    for name, kind in (("red", "uint8"), ("views", "a list")):
        with pytest.raises(ParameterError, match=f"{name}.*{kind}"):
            cloud.with_columns({name: np.zeros(3)})


# --- normals ---


def normals_of(crease: np.ndarray) -> np.ndarray:
    """A unit normal for each point, all on one side."""
    turned = crease[:, 2] > 0.1
    return np.where(turned[:, None], [-np.sin(1.2), 0, np.cos(1.2)], [0.0, 0, 1])


@pytest.mark.parametrize("lists", [False, True], ids=["numbers", "lists"])
@pytest.mark.parametrize("kind", ["float", "double"])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_normals_are_recomputed_on_their_old_side(
    encoding: str, kind: str, lists: bool, default_engine: Engine, noisy_crease: np.ndarray, tmp_path: Path
) -> None:
    old = -0.5 * normals_of(noisy_crease)
    points = noisy_crease.copy()
    points[5, 1] = np.nan
    cloud = PointCloud.read(scan(tmp_path, points, encoding, kind, lists, old))
    filtered, report = filter_cloud(cloud, default_engine, normals="recompute")
    again = through(filtered, tmp_path)
    new, stored = again.column_values(NORMALS), cloud.column_values(NORMALS)
    answered = (new != stored).any(axis=1)
    assert not answered[5]
    assert answered.sum() > 400
    assert (np.sum(new * old, axis=1) > 0)[answered].all()
    np.testing.assert_allclose(np.linalg.norm(new[answered], axis=1), 1, atol=1e-6)
    cosines = np.sum(new * normals_of(noisy_crease), axis=1)[answered]
    assert np.median(-cosines) > 0.95
    assert answered.sum() == len(points) - 1
    assert f"{(~answered).sum()} rows got no normal from the network, as where too few points" in str(report.warnings)
    np.testing.assert_array_equal(again.xyz, filter_cloud(cloud, default_engine)[0].xyz.astype(again.column_types["x"]))


def test_points_that_stay_get_normals_too_and_no_point_moves_for_them(
    default_engine: Engine, noisy_crease: np.ndarray
) -> None:
    clean = noisy_crease.copy()
    clean[:, 2] = 0  # a plane
    for points in (clean, noisy_crease):
        calibration = default_engine.bundle.calibration
        plain, asked = (
            filter_points(
                points,
                default_engine,
                calibration=calibration,
                patch_points=default_engine.bundle.patch_points,
                normals=wanted,
            )
            for wanted in (False, True)
        )
        np.testing.assert_array_equal(plain.points, asked.points)
        np.testing.assert_array_equal(plain.errors, asked.errors)
        assert np.isfinite(asked.normals).all()
        known = np.isfinite(plain.normals)
        np.testing.assert_array_equal(plain.normals[known], asked.normals[known])
    flat = filter_points(
        clean, default_engine, calibration=calibration, patch_points=default_engine.bundle.patch_points, normals=True
    )
    assert np.median(np.abs(flat.normals[:, 2])) > 0.98


def test_normals_are_added_to_a_file_without(default_engine: Engine, noisy_crease: np.ndarray, tmp_path: Path) -> None:
    points = np.vstack([noisy_crease, np.zeros((40, 3)), np.full((2, 3), np.nan)])
    cloud = PointCloud.read(scan(tmp_path, points, "binary_little_endian"))
    filtered, report = filter_cloud(cloud, default_engine, normals="recompute")
    again = through(filtered, tmp_path)
    assert list(again.column_types)[-3:] == list(NORMALS)
    assert again.column_types["nx"] == np.float32
    new = again.column_values(NORMALS)
    np.testing.assert_array_equal(new[600:], 0)
    answered = new.any(axis=1)
    assert any(f"{(~answered).sum()} rows got no normal" in text and "0 0 0" in text for text in report.warnings)
    finite = filtered.xyz[cloud.finite]
    centre = (finite.min(axis=0) + finite.max(axis=0)) / 2
    assert (np.sum(new * (filtered.xyz - centre), axis=1)[answered] > -1e-6).all()
    twice, _ = filter_cloud(filtered, default_engine, normals="recompute")
    np.testing.assert_array_equal(twice.column_values(NORMALS)[600:], 0)


def test_kept_normals_are_warned_of_where_points_moved(
    default_engine: Engine, noisy_crease: np.ndarray, tmp_path: Path
) -> None:
    cloud = PointCloud.read(scan(tmp_path, noisy_crease, normals=normals_of(noisy_crease)))
    filtered, report = filter_cloud(cloud, default_engine)
    (warning,) = report.warnings
    assert "nx, ny, nz" in warning
    assert "unfiltered points" in warning
    assert "normals=recompute" in warning
    np.testing.assert_array_equal(filtered.column_values(NORMALS), normals_of(noisy_crease))
    assert filter_cloud(cloud, default_engine, strength=0.0)[1].warnings == ()


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_normals_are_dropped(encoding: str, engine: Engine, noisy_crease: np.ndarray, tmp_path: Path) -> None:
    cloud = PointCloud.read(scan(tmp_path, noisy_crease, encoding, normals=normals_of(noisy_crease)))
    filtered, report = filter_cloud(cloud, engine, normals="drop")
    assert report.warnings == ()
    again = through(filtered, tmp_path)
    assert list(again.column_types) == ["red", "x", "y", "z", "w"]
    np.testing.assert_array_equal(again.xyz, filter_cloud(cloud, engine)[0].xyz)
    without = PointCloud(noisy_crease.copy())
    assert filter_cloud(without, engine, normals="drop")[0].column_types == {}


def test_normals_that_cannot_be_recomputed(
    engine: Engine, default_engine: Engine, noisy_crease: np.ndarray, tmp_path: Path
) -> None:
    cloud = PointCloud(noisy_crease.copy())
    with pytest.raises(ParameterError, match=r"model 'tiny' has none.*adaptive model such as"):
        filter_cloud(cloud, engine, normals="recompute")
    with pytest.raises(ParameterError, match=r"paper's mode has none.*leave out paper"):
        filter_cloud(cloud, default_engine, normals="recompute", paper=True)
    with pytest.raises(ParameterError, match="keep, recompute, drop"):
        filter_cloud(cloud, default_engine, normals="new")
    layout = [*(Column(axis, "double") for axis in "xyz"), Column("nx", "char")]
    rows = [[*map(float, row), 1] for row in noisy_crease]
    (tmp_path / "odd.ply").write_bytes(write_ply("ascii", [Table("vertex", layout, rows)]).data)
    with pytest.raises(ParameterError, match=r"the file has nx \(int8\).*normals=drop"):
        filter_cloud(PointCloud.read(tmp_path / "odd.ply"), default_engine, normals="recompute")


def test_the_side_of_a_normal() -> None:
    points = np.array([[0.0, 0, 0], [2, 0, 0], [2, 0, 0], [2, 0, 0]])
    normals = np.array([[1.0, 0, 0], [-1, 0, 0], [-1, 0, 0], [np.nan] * 3])
    old = np.array([[np.nan, 0, 0], [0, 0, 0], [-0.1, 5, 0], [1, 0, 0]])
    np.testing.assert_array_equal(signed(normals, old, points)[:, 0], [-1, 1, -1, np.nan])


# --- figures on each point ---

FIGURES = ("scalar_displacement", "scalar_uncertainty", "scalar_outlier")
COLUMNS = ("displacement", "uncertainty", "outlier")


@pytest.mark.parametrize(
    ("text", "columns"),
    [("", ()), (" ", ()), ("outlier", COLUMNS[2:]), ("outlier, displacement,outlier", (COLUMNS[0], COLUMNS[2]))],
)
def test_columns_are_words_between_commas(text: str, columns: tuple[str, ...]) -> None:
    assert parse_columns(text) == columns


@pytest.mark.parametrize("text", ["colour", ",", "outlier,", "scalar_outlier", "Outlier"])
def test_a_column_that_is_none_names_those_that_are(text: str) -> None:
    with pytest.raises(ParameterError, match="displacement, uncertainty, outlier"):
        parse_columns(text)


@pytest.mark.parametrize("lists", [False, True], ids=["numbers", "lists"])
@pytest.mark.parametrize("kind", ["float", "double"])
@pytest.mark.parametrize("encoding", ENCODINGS)
def test_figures_on_each_point(
    encoding: str, kind: str, lists: bool, default_engine: Engine, noisy_crease: np.ndarray, tmp_path: Path
) -> None:
    points = np.vstack([noisy_crease, np.zeros((40, 3)), np.full((2, 3), np.nan)])
    cloud = PointCloud.read(scan(tmp_path, points, encoding, kind, lists))
    filtered, report = filter_cloud(cloud, default_engine, columns=COLUMNS)
    again = through(filtered, tmp_path)
    assert list(again.column_types)[-3:] == list(FIGURES)
    assert {again.column_types[name] for name in FIGURES} == {np.dtype(np.float32)}
    displacement, uncertainty, outlier = again.column_values(FIGURES).T
    moves = np.linalg.norm(filtered.xyz[:640] - cloud.xyz[:640], axis=1)
    np.testing.assert_allclose(displacement, [*moves, 0, 0], rtol=1e-6)
    assert np.isnan(uncertainty[600:]).all()
    assert np.nanmean(uncertainty) == pytest.approx(report.expected_error, rel=1e-5)
    np.testing.assert_array_equal(outlier[600:], 1)
    assert set(outlier[:600]) <= {0, 1}
    assert outlier[:600].mean() < 0.1
    np.testing.assert_array_equal(filtered.xyz, filter_cloud(cloud, default_engine)[0].xyz)


def test_a_point_that_is_far_from_everything_is_an_outlier(default_engine: Engine, noisy_crease: np.ndarray) -> None:
    points = np.vstack([noisy_crease, [[0.5, 0.5, 3.0], [3.0, -2.0, 0.5]]])
    filtered, _ = filter_cloud(PointCloud(points), default_engine, columns=["outlier"])
    outlier = filtered.column_values(["scalar_outlier"])[:, 0]
    np.testing.assert_array_equal(outlier[600:], 1)
    assert outlier[:600].mean() < 0.1
    unmoved, _ = filter_cloud(PointCloud(points), default_engine, columns=["outlier"], strength=0.0)
    np.testing.assert_array_equal(unmoved.column_values(["scalar_outlier"])[:, 0], outlier)


def test_errors_are_not_known_of_shortened_moves(default_engine: Engine, noisy_crease: np.ndarray) -> None:
    cloud = PointCloud(noisy_crease.copy())
    full = filter_cloud(cloud, default_engine, columns=COLUMNS)[0].column_values(FIGURES)
    limit = float(np.median(full[:, 0]))
    limited = filter_cloud(cloud, default_engine, columns=COLUMNS, max_move=limit)[0].column_values(FIGURES)
    known = full[:, 0] <= limit
    np.testing.assert_array_equal(limited[known, 1], full[known, 1])
    assert np.isnan(limited[~known, 1]).all()
    np.testing.assert_array_equal(limited[:, 2], full[:, 2])


def test_figures_of_a_network_that_does_not_tell_its_errors(engine: Engine, noisy_crease: np.ndarray) -> None:
    cloud = PointCloud(noisy_crease.copy())
    filtered, report = filter_cloud(cloud, engine, columns=COLUMNS, radius=Radius(0.2, relative=False))
    figures = filtered.column_values(FIGURES)
    assert np.isnan(figures[:, 1]).all()
    np.testing.assert_array_equal(figures[:, 2], 0)
    assert report.warnings == ("no expected error is known of any point, so scalar_uncertainty is NaN everywhere",)


def test_columns_that_are_there_already_are_refused(engine: Engine, noisy_crease: np.ndarray, tmp_path: Path) -> None:
    cloud = PointCloud.read(scan(tmp_path, noisy_crease))
    once = through(filter_cloud(cloud, engine, columns=["displacement"])[0], tmp_path)
    with pytest.raises(ParameterError, match=r"scalar_displacement already.*leave displacement out"):
        filter_cloud(once, engine, columns=COLUMNS)
    assert filter_cloud(once, engine, columns=["outlier"])[0].column_types["scalar_outlier"] is not None
