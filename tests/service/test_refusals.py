"""What the service says to files and parameters it does not take."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from starlette.testclient import TestClient

XYZ = "property float x\nproperty float y\nproperty float z\n"


def header(count: int, encoding: str = "ascii", properties: str = XYZ) -> bytes:
    return f"ply\nformat {encoding} 1.0\nelement vertex {count}\n{properties}end_header\n".encode()


FILES: dict[str, tuple[bytes, int, str]] = {
    "empty": (b"", 400, "malformed-request"),
    "text": (b"hello, world", 415, "unsupported-format"),
    "cut in the header": (b"ply\nformat ascii 1.0\nelement ver", 400, "malformed-file"),
    "cut in the rows": (header(100, "binary_little_endian") + b"\0" * 600, 400, "malformed-file"),
    "cut in the lines": (header(3) + b"0 0 0\n1 1 1 1 1\n", 400, "malformed-file"),
    "a billion points that are not there": (header(10**9, "binary_little_endian") + b"abc", 413, "limit-exceeded"),
    "as many as allowed that are not there": (header(10**7, "binary_little_endian") + b"abc", 400, "malformed-file"),
    "no z": (header(1, properties="property float x\nproperty float y\n") + b"1 1\n", 422, "missing-coordinates"),
    "no vertices": (b"ply\nformat ascii 1.0\nelement face 0\nend_header\n", 422, "missing-coordinates"),
    "no rows": (header(0), 422, "too-few-points"),
    "one point": (header(1) + b"1 2 3\n", 422, "too-few-points"),
    "nothing but NaN": (header(1000) + b"nan nan nan\n" * 1000, 422, "too-few-points"),
    "a thousand equal points": (header(1000) + b"1 2 3\n" * 1000, 422, "degenerate-cloud"),
}

PARAMETERS = {
    "iterations=0": (422, "parameter-out-of-range"),
    "iterations=11": (422, "parameter-out-of-range"),
    "iterations=two": (422, "parameter-out-of-range"),
    "iterations=99999999999999999999999999": (422, "parameter-out-of-range"),
    "radius=0": (422, "parameter-out-of-range"),
    "radius=-1": (422, "parameter-out-of-range"),
    "radius=101%25": (422, "parameter-out-of-range"),
    "radius=nan": (422, "parameter-out-of-range"),
    "radius=inf": (422, "parameter-out-of-range"),
    "radius=wide": (422, "parameter-out-of-range"),
    "radius=" + "9" * 50: (422, "parameter-out-of-range"),
    "seed=-1": (422, "parameter-out-of-range"),
    f"seed={2**63}": (422, "parameter-out-of-range"),
    "strength=-0.1": (422, "parameter-out-of-range"),
    "strength=nan": (422, "parameter-out-of-range"),
    "strength=full": (422, "parameter-out-of-range"),
    "max_move=0": (422, "parameter-out-of-range"),
    "max_move=-1": (422, "parameter-out-of-range"),
    "max_move=inf": (422, "parameter-out-of-range"),
    "max_move=nan": (422, "parameter-out-of-range"),
    "paper=perhaps": (422, "parameter-out-of-range"),
    "normals=new": (422, "parameter-out-of-range"),
    "normals=recompute": (422, "parameter-out-of-range"),  # this network answers without normals
    "columns=colour": (422, "parameter-out-of-range"),
    "columns=displacement,": (422, "parameter-out-of-range"),
    "format=las": (422, "parameter-out-of-range"),
    "model=nobody": (404, "model-not-found"),
    "model=..%2Ftiny": (404, "model-not-found"),
    "model=broken": (500, "invalid-model"),
}


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("as_form", [False, True], ids=["raw", "form"])
def test_bad_files(client: TestClient, temp_dir: Path, name: str, as_form: bool) -> None:
    content, status, code = FILES[name]
    answer = (
        client.post("/filter", files={"file": ("scan.ply", content)})
        if as_form
        else client.post("/filter", content=content)
    )
    check(answer, status, code)
    assert list(temp_dir.iterdir()) == []


@pytest.mark.parametrize("asked", ["two", "0", "11", "1.5", "", "9" * 50])
def test_iterations_are_a_word_or_a_number(client: TestClient, ply: bytes, asked: str) -> None:
    detail = check(client.post(f"/filter?iterations={asked}", content=ply), 422, "parameter-out-of-range")["detail"]
    assert detail == f"iterations must be auto or a number from 1 to 10, got {asked[:40]}"


@pytest.mark.parametrize("path", ["/filter", "/jobs"])
@pytest.mark.parametrize("query", PARAMETERS)
def test_bad_parameters(client: TestClient, ply: bytes, path: str, query: str) -> None:
    check(client.post(f"{path}?{query}", content=ply), *PARAMETERS[query])


@pytest.mark.parametrize(
    ("query", "name", "limit", "actual"),
    [("strength=2", "strength", 1, "2"), ("max_move=-0.5", "max_move", 0, "-0.5"), ("seed=-1", "seed", 0, "-1")],
)
def test_a_parameter_out_of_range_is_told_with_its_limit(
    client: TestClient, ply: bytes, query: str, name: str, limit: float, actual: str
) -> None:
    problem = check(client.post(f"/filter?{query}", content=ply), 422, "parameter-out-of-range")
    assert (problem["limit"], problem["actual"]) == (limit, actual)
    assert str(problem["detail"]).startswith(f"{name}: ")
    assert f" {limit}, got {actual}" in str(problem["detail"])


def test_limits_and_knobs_are_named(make_client: Callable[..., TestClient], ply: bytes) -> None:
    client = make_client(max_points=100, max_iterations=2, max_upload_bytes=20_000)
    problem = check(client.post("/filter", content=ply), 413, "limit-exceeded")
    assert (problem["limit"], problem["actual"]) == (100, 500)
    assert "POINTFILTER_MAX_POINTS" in str(problem["hint"])
    problem = check(client.post("/filter?iterations=3", content=ply), 422, "parameter-out-of-range")
    assert (problem["limit"], problem["actual"]) == (2, 3)
    assert "POINTFILTER_MAX_ITERATIONS" in str(problem["hint"])
    problem = check(client.post("/filter", content=bytes(20_001)), 413, "limit-exceeded")
    assert (problem["limit"], problem["actual"]) == (20_000, 20_001)
    assert "POINTFILTER_MAX_UPLOAD_BYTES" in str(problem["hint"])


@pytest.mark.parametrize(("limit", "passes"), [(1, "1"), (2, "2"), (3, "2")])
def test_the_limit_of_passes_holds_where_none_are_named(
    make_client: Callable[..., TestClient], ply: bytes, limit: int, passes: str
) -> None:
    answer = make_client(max_iterations=limit).post("/filter?paper=true", content=ply)
    assert answer.headers["x-iterations"] == passes


def test_a_file_of_exactly_the_limit_is_taken(make_client: Callable[..., TestClient], ply: bytes) -> None:
    client = make_client(max_upload_bytes=len(ply))
    assert client.post("/filter", content=ply).status_code == 200
    assert client.post("/filter", files={"file": ("scan.ply", ply)}).status_code == 200
    check(client.post("/filter", files={"file": ("scan.ply", ply + b"\0")}), 413, "limit-exceeded")


def test_damage_is_told_without_the_servers_words(client: TestClient, ply: bytes, bundles: Path) -> None:
    answer = client.post("/filter?model=broken", content=ply)
    assert "sha256" not in answer.text
    assert str(bundles) not in answer.text


@pytest.mark.parametrize(
    ("method", "path", "status", "code"),
    [
        ("GET", "/nothing/here", 404, "not-found"),
        ("GET", "/models/nobody", 404, "model-not-found"),
        ("GET", "/models/broken", 500, "invalid-model"),
        ("GET", "/problems/nothing", 404, "not-found"),
        ("GET", "/filter", 405, "method-not-allowed"),
        ("PUT", "/filter", 405, "method-not-allowed"),
        ("DELETE", "/models", 405, "method-not-allowed"),
        ("OPTIONS", "/filter", 405, "method-not-allowed"),
    ],
)
def test_wrong_addresses_and_methods(client: TestClient, method: str, path: str, status: int, code: str) -> None:
    answer = client.request(method, path)
    check(answer, status, code)
    if status == 405:
        assert answer.headers["allow"] in ("POST", "GET")


def test_head_of_filter_is_refused_and_of_pages_is_not(client: TestClient) -> None:
    refused = client.head("/filter")
    assert (refused.status_code, refused.headers["allow"], refused.content) == (405, "POST", b"")
    page = client.head("/health/live")
    assert (page.status_code, page.content) == (200, b"")


def test_no_other_site_is_let_in(client: TestClient) -> None:
    answer = client.get("/version", headers={"Origin": "https://elsewhere.example"})
    assert not [name for name in answer.headers if name.startswith("access-control-")]


def check(answer: object, status: int, code: str) -> dict[str, object]:
    """Asserts a whole problem; returns it."""
    assert answer.status_code == status, answer.text  # type: ignore[attr-defined]
    assert answer.headers["content-type"] == "application/problem+json"  # type: ignore[attr-defined]
    problem: dict[str, object] = answer.json()  # type: ignore[attr-defined]
    assert problem["code"] == code
    assert problem["type"] == f"/problems/{code}"
    assert problem["status"] == status
    assert problem["request_id"] == answer.headers["x-request-id"]  # type: ignore[attr-defined]
    assert str(problem["instance"]).endswith(f"#{problem['request_id']}")
    assert problem["title"]
    assert problem["detail"]
    assert problem["hint"]
    for secret in ("Traceback", "/tmp", "site-packages", ".py"):  # noqa: S108 - looked for, not used
        assert secret not in answer.text  # type: ignore[attr-defined]
    return problem
