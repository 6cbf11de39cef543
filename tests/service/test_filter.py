"""POST /filter when all goes well."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
from numpy.typing import NDArray
from starlette.testclient import TestClient

from pointfilter import Engine, PointCloud, Radius, Report, filter_cloud, load_bundle
from pointfilter.models import DEFAULT_MODEL, find_model
from tests.ply_files import ply_bytes


@pytest.fixture
def expected(bundles: Path, cloud: PointCloud, ply: bytes, tmp_path: Path) -> Callable[..., bytes]:
    """What the library makes of the same file."""
    engine = Engine(load_bundle(bundles / "tiny"), threads=1)

    def make(encoding: str = "same", **options: object) -> bytes:
        (tmp_path / "in.ply").write_bytes(ply)
        filtered, report = filter_cloud(PointCloud.read(tmp_path / "in.ply"), engine, **options)  # type: ignore[arg-type]
        filtered.write(tmp_path / "out.ply", encoding, report.comment)
        return (tmp_path / "out.ply").read_bytes()

    return make


def test_raw_body_gives_what_the_library_gives(
    client: TestClient, ply: bytes, expected: Callable[..., bytes], cloud: PointCloud, tmp_path: Path
) -> None:
    answer = client.post("/filter", content=ply)
    assert answer.status_code == 200
    assert answer.content == expected()
    (tmp_path / "answer.ply").write_bytes(answer.content)
    assert not np.array_equal(PointCloud.read(tmp_path / "answer.ply").xyz, cloud.xyz)


def test_form_gives_the_same_file(client: TestClient, ply: bytes) -> None:
    form = client.post("/filter", files={"file": ("scan.ply", ply)})
    assert form.status_code == 200
    assert form.content == client.post("/filter", content=ply).content


def test_curls_default_content_type_is_a_raw_body(client: TestClient, ply: bytes) -> None:
    headers = {"Content-Type": "application/x-www-form-urlencoded"}
    assert client.post("/filter", content=ply, headers=headers).status_code == 200


@pytest.mark.parametrize(
    ("query", "options"),
    [
        ("iterations=3", {"iterations": 3}),
        ("iterations=auto", {"iterations": None}),
        ("strength=0.5", {"strength": 0.5}),
        ("max_move=0.01", {"max_move": 0.01}),
        ("paper=true", {"paper": True}),
        ("normals=keep", {"normals": "keep"}),
        ("normals=drop", {"normals": "drop"}),
        ("columns=displacement,outlier", {"columns": ("displacement", "outlier")}),
        ("columns=", {"columns": ()}),
        ("radius=20%25", {"radius": Radius(0.2, relative=True)}),
        ("radius=20%", {"radius": Radius(0.2, relative=True)}),
        ("radius=0.3", {"radius": Radius(0.3, relative=False)}),
        ("radius=0.8&seed=7", {"radius": Radius(0.8, relative=False), "seed": 7}),
        ("format=ascii", {"encoding": "ascii"}),
        ("format=binary_big_endian", {"encoding": "binary_big_endian"}),
        ("model=tiny&format=same", {}),
    ],
)
def test_parameters_reach_the_filter(
    client: TestClient, ply: bytes, expected: Callable[..., bytes], query: str, options: dict[str, object]
) -> None:
    answer = client.post(f"/filter?{query}", content=ply)
    assert answer.status_code == 200, answer.text
    assert answer.content == expected(**options)


def test_headers_say_what_was_done(client: TestClient, ply: bytes) -> None:
    answer = client.post("/filter?radius=0.3", files={"file": ("scan.ply", ply)})
    assert answer.headers["content-disposition"] == 'attachment; filename="scan_filtered.ply"'
    assert answer.headers["content-length"] == str(len(answer.content))
    assert answer.headers["etag"] == f'"{hashlib.sha256(answer.content).hexdigest()}"'
    assert answer.headers["x-model"] == "tiny"
    assert answer.headers["x-points"] == "500"
    assert (answer.headers["x-iterations"], answer.headers["x-moved"]) == ("2", "500")  # the paper's mode
    assert answer.headers["x-radius"] == "0.3"
    assert "x-expected-error" not in answer.headers  # this network does not tell it
    assert "x-warnings" not in answer.headers
    stages = re.findall(r"(\w+);dur=\d+\.\d", answer.headers["server-timing"])
    assert stages == ["queue", "parse", "index", "balls", "patches", "infer", "write"]


def test_headers_say_what_an_adaptive_network_expects(client: TestClient, ply: bytes, tmp_path: Path) -> None:
    answer = client.post(f"/filter?model={DEFAULT_MODEL}", content=ply)
    report = report_of(ply, tmp_path)
    assert report.expected_error is not None
    assert 0 < report.moved <= 500
    assert answer.headers["x-iterations"] == str(report.iterations)
    assert answer.headers["x-moved"] == str(report.moved)
    assert float(answer.headers["x-radius"]) == pytest.approx(report.radius, rel=1e-8)
    assert float(answer.headers["x-expected-error"]) == pytest.approx(report.expected_error, rel=1e-3)


def test_the_papers_mode_of_an_adaptive_network(
    client: TestClient, cloud: PointCloud, ply: bytes, tmp_path: Path
) -> None:
    answer = client.post(f"/filter?model={DEFAULT_MODEL}&paper=true", content=ply)
    report = report_of(ply, tmp_path, paper=True)
    low, high = cloud.xyz.min(axis=0), cloud.xyz.max(axis=0)
    assert float(answer.headers["x-radius"]) == pytest.approx(0.05 * np.linalg.norm(high - low), rel=1e-8)
    assert (answer.headers["x-iterations"], answer.headers["x-moved"]) == ("2", str(report.moved))
    assert answer.headers.get("x-expected-error") is None
    assert answer.content != client.post(f"/filter?model={DEFAULT_MODEL}", content=ply).content


def test_normals_are_written(client: TestClient, ply: bytes, tmp_path: Path) -> None:
    answer = client.post(f"/filter?model={DEFAULT_MODEL}&normals=recompute", content=ply)
    assert answer.status_code == 200, answer.text
    (tmp_path / "answer.ply").write_bytes(answer.content)
    normals = PointCloud.read(tmp_path / "answer.ply").column_values(("nx", "ny", "nz"))
    answered = normals.any(axis=1)
    assert answered.sum() >= int(answer.headers["x-moved"]) > 0
    np.testing.assert_allclose(np.linalg.norm(normals[answered], axis=1), 1, atol=1e-6)


@pytest.mark.parametrize("model", ["tiny", DEFAULT_MODEL])
def test_placeholder_rows_are_warned_about(client: TestClient, cloud: PointCloud, model: str) -> None:
    rows = [*map(tuple, cloud.xyz), *[(0.0, 0.0, 0.0)] * 200]
    content = ply_bytes("binary_little_endian", rows, ["double x", "double y", "double z"])
    answer = client.post(f"/filter?model={model}", content=content)
    assert answer.status_code == 200
    warnings = unquote(answer.headers["x-warnings"])
    assert warnings.startswith("200 rows share places that hold many more rows than their surroundings")
    assert answer.headers["x-points"] == "700"
    assert 0 < int(answer.headers["x-moved"]) <= 500


def report_of(ply: bytes, folder: Path, paper: bool = False) -> Report:
    """Of the library, for the default model."""
    (folder / "in.ply").write_bytes(ply)
    engine = Engine(find_model(DEFAULT_MODEL), threads=1)
    return filter_cloud(PointCloud.read(folder / "in.ply"), engine, paper=paper)[1]


@pytest.mark.parametrize("model", ["tiny", DEFAULT_MODEL])
def test_displacements_are_as_long_as_asked_for(
    client: TestClient, cloud: PointCloud, ply: bytes, tmp_path: Path, model: str
) -> None:
    def displacements(query: str) -> NDArray[np.float64]:
        answer = client.post(f"/filter?model={model}&{query}", content=ply)
        assert answer.status_code == 200, answer.text
        (tmp_path / "answer.ply").write_bytes(answer.content)
        moves = PointCloud.read(tmp_path / "answer.ply").xyz - cloud.xyz
        assert int(answer.headers["x-moved"]) == np.any(moves, axis=1).sum()
        return moves

    full = displacements("strength=1")
    lengths = np.linalg.norm(full, axis=1)
    longest = float(np.median(lengths[lengths > 0]))
    assert np.array_equal(displacements("strength=0"), np.zeros_like(full))
    np.testing.assert_allclose(displacements("strength=0.5"), full / 2, atol=1e-12)
    bounded = np.linalg.norm(displacements(f"max_move={longest!r}"), axis=1)
    np.testing.assert_allclose(bounded, np.minimum(lengths, longest), atol=1e-12)
    assert (lengths > longest * 1.01).any()  # so that there was something to bound
    both = np.linalg.norm(displacements(f"strength=0.5&max_move={longest!r}"), axis=1)
    np.testing.assert_allclose(both, np.minimum(lengths / 2, longest), atol=1e-12)


def test_another_model_is_loaded_when_asked_for(client: TestClient, ply: bytes) -> None:
    other = client.post("/filter?model=other", content=ply)
    assert other.headers["x-model"] == "other"
    assert other.content != client.post("/filter", content=ply).content


def test_rows_without_a_place_and_other_columns_pass_through(client: TestClient, tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    rows = [f"{x:.6f} {y:.6f} {z:.6f} {i % 256}" for i, (x, y, z) in enumerate(generator.uniform(size=(200, 3)))]
    rows[17] = "nan nan nan 17"
    header = "ply\nformat ascii 1.0\ncomment kept\nelement vertex 200\nproperty float x\nproperty float y\n"
    text = header + "property float z\nproperty uchar red\nend_header\n" + "\n".join(rows) + "\n"
    answer = client.post("/filter", content=text.encode())
    assert answer.status_code == 200
    lines = answer.text.split("end_header\n")[1].splitlines()
    assert lines[17] == rows[17]
    assert [line.split()[3] for line in lines] == [row.split()[3] for row in rows]
    assert "comment kept\n" in answer.text


def test_nothing_stays_behind(client: TestClient, ply: bytes, temp_dir: Path) -> None:
    assert client.post("/filter", content=ply).status_code == 200
    assert client.post("/filter", content=b"no ply").status_code == 415
    assert list(temp_dir.iterdir()) == []


def test_request_id_of_the_caller_is_kept_when_sane(client: TestClient) -> None:
    assert client.get("/version", headers={"X-Request-ID": "abc-1.2_3"}).headers["x-request-id"] == "abc-1.2_3"
    for bad in ("x" * 65, "a b", "<script>", "-", ""):
        answer = client.get("/version", headers={"X-Request-ID": bad})
        assert re.fullmatch(r"[0-9a-f]{32}", answer.headers["x-request-id"])
