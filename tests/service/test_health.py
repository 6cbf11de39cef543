"""Alive, started, ready, draining."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any

import pytest
from starlette.testclient import TestClient

import service.engines
from pointfilter import Engine
from service.app import create_app
from service.settings import Settings
from tests.service.apps import house_of, until
from tests.service.test_refusals import check


def test_ready_only_after_a_real_inference(
    make_settings: Callable[..., Settings], monkeypatch: pytest.MonkeyPatch, ply: bytes
) -> None:
    go_on = threading.Event()
    inferences: list[int] = []

    class Slow(Engine):
        def __call__(self, patches: Any, *others: Any) -> Any:
            go_on.wait(20)
            inferences.append(len(patches))
            return super().__call__(patches, *others)

    monkeypatch.setattr(service.engines, "Engine", Slow)
    with TestClient(create_app(make_settings())) as client:
        assert client.get("/health/live").json() == {"status": "ok"}
        for path in ("/health", "/health/ready", "/health/startup"):
            answer = client.get(path)
            check(answer, 503, "not-ready")
            assert int(answer.headers["retry-after"]) >= 1
        check(client.post("/filter", content=ply), 503, "not-ready")
        assert inferences == []
        go_on.set()
        until(lambda: client.get("/health/ready").status_code == 200)
        assert inferences == [2]
        assert client.get("/health/startup").status_code == 200


@pytest.mark.parametrize("settings", [{"model": "broken"}, {"model": "nobody"}, {"device": "cuda"}])
def test_a_default_model_that_cannot_be_used_is_never_ready(
    make_settings: Callable[..., Settings], caplog: pytest.LogCaptureFixture, settings: dict[str, str]
) -> None:
    app = create_app(make_settings(**settings))
    ended: list[bool] = []
    app.state.house.on_failure = lambda: ended.append(True)
    with TestClient(app) as client, caplog.at_level(logging.CRITICAL):
        until(lambda: bool(ended))
        problem = check(client.get("/health/ready"), 503, "not-ready")
        assert "failed" in str(problem["detail"])
        assert client.get("/health/live").status_code == 503  # only a new process can help
    assert "cannot work" in caplog.text


def test_a_folder_for_temporary_files_that_is_not_there_is_known_at_the_start(
    make_settings: Callable[..., Settings],
) -> None:
    settings = make_settings()
    assert settings.temp_dir
    settings.temp_dir.rmdir()
    with TestClient(create_app(settings)) as client:
        until(lambda: "failed" in client.get("/health/ready").text)


def test_draining_takes_nothing_new(client: TestClient, ply: bytes) -> None:
    house_of(client).drain()
    answer = client.post("/filter", content=ply)
    check(answer, 503, "draining")
    assert int(answer.headers["retry-after"]) >= 1
    check(client.get("/health/ready"), 503, "draining")
    check(client.get("/health"), 503, "draining")
    assert client.get("/health/live").status_code == 200
    assert client.get("/health/startup").status_code == 200


def test_summary(client: TestClient) -> None:
    found = client.get("/health").json()
    assert found.pop("uptime_seconds") >= 0
    assert found == {
        "status": "ok", "model": "tiny", "provider": "CPUExecutionProvider",
        "workers": 1, "in_progress": 0, "waiting": 0, "places": 9,
    }  # fmt: skip
