"""POST /look."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from starlette.testclient import TestClient

import service.work
from pointfilter import Engine, PointCloud, look
from pointfilter.models import DEFAULT_MODEL, find_model
from service.keys import new_key
from tests.service.apps import Gate, house_of, metric, until
from tests.service.test_refusals import FILES, check


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> Gate:
    gate = Gate("look")
    monkeypatch.setattr(service.work, "look", gate)
    return gate


@pytest.mark.parametrize("as_form", [False, True], ids=["raw", "form"])
def test_the_answer_is_what_the_library_finds(
    client: TestClient, cloud: PointCloud, ply: bytes, temp_dir: Path, as_form: bool
) -> None:
    sent = {"files": {"file": ("scan.ply", ply)}} if as_form else {"content": ply}
    answer = client.post(f"/look?model={DEFAULT_MODEL}&seed=3", **sent)  # type: ignore[arg-type]
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/json"
    found = answer.json()
    expected = look(cloud, Engine(find_model(DEFAULT_MODEL), threads=1), seed=3).as_dict()
    assert found.pop("seconds") > 0
    del expected["seconds"]
    assert found == {name: list(value) if isinstance(value, tuple) else value for name, value in expected.items()}
    assert found["verdict"] == "noisy"
    assert list(temp_dir.iterdir()) == []
    assert metric(client, "http_requests_total", method="POST", route="/look", status="200") == 1
    assert metric(client, "pointfilter_requests_total", model=DEFAULT_MODEL, outcome="ok") == 0  # nothing was filtered


def test_a_model_that_tells_no_errors(client: TestClient, ply: bytes) -> None:
    found = client.post("/look", content=ply).json()
    assert (found["verdict"], found["model"], found["noise"]) == ("cannot tell", "tiny", None)
    assert "adaptive model" in found["warnings"][0]


@pytest.mark.parametrize("name", FILES)
def test_bad_files(client: TestClient, temp_dir: Path, name: str) -> None:
    content, status, code = FILES[name]
    check(client.post("/look", content=content), status, code)
    assert list(temp_dir.iterdir()) == []


@pytest.mark.parametrize(
    ("query", "status", "code"),
    [
        ("seed=-1", 422, "parameter-out-of-range"),
        ("model=nobody", 404, "model-not-found"),
        ("model=broken", 500, "invalid-model"),
    ],
)
def test_bad_parameters(client: TestClient, ply: bytes, query: str, status: int, code: str) -> None:
    check(client.post(f"/look?{query}", content=ply), status, code)


def test_limits_are_those_of_the_filter(make_client: Callable[..., TestClient], ply: bytes) -> None:
    client = make_client(max_points=100, max_upload_bytes=20_000)
    assert check(client.post("/look", content=ply), 413, "limit-exceeded")["limit"] == 100
    assert check(client.post("/look", content=bytes(20_001)), 413, "limit-exceeded")["limit"] == 20_000


def test_a_key_is_wanted_where_there_are_keys(
    make_client: Callable[..., TestClient], ply: bytes, tmp_path: Path
) -> None:
    key, line = new_key("mine")
    (tmp_path / "keys").write_text(line)
    client = make_client(keys_file=tmp_path / "keys")
    check(client.post("/look", content=ply), 401, "unauthorized")
    assert client.post("/look", content=ply, headers={"Authorization": f"Bearer {key}"}).status_code == 200


def test_looks_and_requests_wait_in_one_queue(make_client: Callable[..., TestClient], gate: Gate, ply: bytes) -> None:
    client = make_client(workers=1, queue_size=1)
    with ThreadPoolExecutor(2) as pool:
        under_way = [pool.submit(client.post, "/look", content=ply) for _ in range(2)]
        until(lambda: house_of(client).admission.waiting == 1 and gate.entered == 1)
        for path in ("/look", "/filter"):
            check(client.post(path, content=ply), 429, "queue-full")
        gate.open.set()
        assert [each.result().status_code for each in under_way] == [200, 200]
    assert house_of(client).admission.held == 0


def test_the_deadline_stops_the_work(make_client: Callable[..., TestClient], gate: Gate, ply: bytes) -> None:
    problem = check(make_client(timeout_seconds=0.2).post("/look", content=ply), 504, "deadline-exceeded")
    assert "POINTFILTER_TIMEOUT_SECONDS" in str(problem["hint"])
    assert "respond-async" not in str(problem["hint"])
    assert gate.stopped == 1


def test_the_document_describes_the_answer(client: TestClient) -> None:
    document = client.get("/openapi.json").json()
    operation = document["paths"]["/look"]["post"]
    assert set(operation["requestBody"]["content"]) == {"multipart/form-data", "application/octet-stream"}
    assert {parameter["name"] for parameter in operation["parameters"]} == {"model", "seed"}
    assert {"200", "400", "401", "404", "413", "415", "422", "429", "500", "503", "504"} <= set(operation["responses"])
    assert "202" not in operation["responses"]
    properties = document["components"]["schemas"]["Look"]["properties"]
    assert properties["verdict"]["enum"] == ["clean", "noisy", "cannot tell"]
