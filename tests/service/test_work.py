"""Queue, deadline and disconnect: nothing waits without bound, and what nobody wants any more is stopped."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from service.app import create_app
from service.settings import Settings
from service.work import in_worker
from tests.service.apps import Gate, house_of, metric, until
from tests.service.test_refusals import check


@contextmanager
def senders(client: TestClient, content: bytes, count: int) -> Iterator[list[Future[Any]]]:
    """Requests under way, each in a thread."""
    with ThreadPoolExecutor(count) as pool:
        yield [pool.submit(client.post, "/filter", content=content) for _ in range(count)]


def test_beyond_the_queue_is_refused_at_once_and_the_rest_is_served(
    make_client: Callable[..., TestClient], gate: Gate, ply: bytes, temp_dir: Path
) -> None:
    client = make_client(workers=1, queue_size=2)
    admission = house_of(client).admission
    with senders(client, ply, 3) as under_way:
        until(lambda: admission.waiting == 2 and gate.entered == 1)
        assert metric(client, "pointfilter_queue_depth") == 2
        assert metric(client, "pointfilter_in_progress") == 1
        refused = client.post("/filter", content=ply)
        problem = check(refused, 429, "queue-full")
        assert (problem["limit"], problem["actual"]) == (3, 4)
        assert int(refused.headers["retry-after"]) >= 1
        assert client.get("/health").json()["waiting"] == 2
        gate.open.set()
        assert [future.result().status_code for future in under_way] == [200, 200, 200]
    assert (admission.held, admission.waiting, admission.running) == (0, 0, 0)
    assert metric(client, "pointfilter_requests_total", model="unknown", outcome="rejected") == 1
    assert metric(client, "pointfilter_requests_total", model="tiny", outcome="ok") == 3
    assert list(temp_dir.iterdir()) == []


def test_two_workers_work_at_the_same_time(make_client: Callable[..., TestClient], gate: Gate, ply: bytes) -> None:
    client = make_client(workers=2)
    with senders(client, ply, 2) as under_way:
        until(lambda: gate.entered == 2)
        gate.open.set()
        assert [future.result().status_code for future in under_way] == [200, 200]


def test_the_deadline_stops_the_work_and_frees_the_worker(
    make_client: Callable[..., TestClient], gate: Gate, ply: bytes, temp_dir: Path
) -> None:
    client = make_client(timeout_seconds=0.2)
    problem = check(client.post("/filter", content=ply), 504, "deadline-exceeded")
    assert problem["limit"] == 0.2
    assert "POINTFILTER_TIMEOUT_SECONDS" in str(problem["hint"])
    assert gate.stopped == 1
    assert metric(client, "pointfilter_requests_total", model="tiny", outcome="timeout") == 1
    assert list(temp_dir.iterdir()) == []
    gate.open.set()
    assert house_of(client).admission.running == 0


def test_the_deadline_counts_the_time_in_the_queue(
    make_client: Callable[..., TestClient], gate: Gate, ply: bytes
) -> None:
    client = make_client(timeout_seconds=0.3)
    with senders(client, ply, 2) as under_way:
        answers = [future.result() for future in under_way]
    assert [answer.status_code for answer in answers] == [504, 504]
    assert house_of(client).admission.held == 0


class Connection:
    """An ASGI connection whose client says what it has to say and then, at some time, goes away."""

    def __init__(self, chunks: list[bytes], complete: bool = True) -> None:
        self.gone = asyncio.Event()
        self.sent: list[Any] = []
        self._chunks = chunks
        self._complete = complete

    async def receive(self) -> dict[str, object]:
        if self._chunks:
            body = self._chunks.pop(0)
            return {"type": "http.request", "body": body, "more_body": bool(self._chunks) or not self._complete}
        await self.gone.wait()
        return {"type": "http.disconnect"}

    async def send(self, message: Any) -> None:
        self.sent.append(message)


def scope_of(path: str, headers: list[tuple[bytes, bytes]]) -> dict[str, object]:
    return {
        "type": "http", "http_version": "1.1", "method": "POST", "scheme": "http", "path": path, "query_string": b"",
        "root_path": "", "headers": headers, "server": ("test", 80), "client": ("test", 1), "asgi": {"version": "3.0"},
    }  # fmt: skip


@pytest.mark.parametrize("moment", ["working", "waiting", "uploading"])
def test_a_client_that_goes_away_takes_its_work_with_it(
    make_settings: Callable[..., Settings], gate: Gate, ply: bytes, temp_dir: Path, moment: str
) -> None:
    app = create_app(make_settings(workers=1))
    house = app.state.house

    async def play() -> None:
        async with app.router.lifespan_context(app):
            await eventually(lambda: house.provider is not None)
            first = Connection([ply[:100], ply[100:]])
            tasks = [asyncio.create_task(app(scope_of("/filter", []), first.receive, first.send))]
            leaving, entered = first, 1
            await eventually(lambda: gate.entered == 1)
            if moment != "working":
                leaving = Connection([ply[:100]] if moment == "uploading" else [ply], complete=moment == "waiting")
                tasks.append(asyncio.create_task(app(scope_of("/filter", []), leaving.receive, leaving.send)))
                await eventually(
                    lambda: house.admission.held == 2 and (moment == "uploading" or house.admission.waiting == 1)
                )
            leaving.gone.set()
            await asyncio.wait_for(tasks[-1], 10)
            assert leaving.sent[0]["status"] == 499
            assert gate.entered == entered
            assert gate.stopped == (1 if moment == "working" else 0)
            gate.open.set()
            await asyncio.wait_for(asyncio.gather(*tasks), 10)
            if moment != "working":
                assert first.sent[0]["status"] == 200
        assert (house.admission.held, house.admission.waiting, house.admission.running) == (0, 0, 0)
        assert list(temp_dir.iterdir()) == []
        value = house.telemetry.registry.get_sample_value
        assert value("pointfilter_requests_total", {"model": "tiny", "outcome": "cancelled"}) == 1

    asyncio.run(play())


def test_a_cancelled_server_task_stops_the_work_too(
    make_settings: Callable[..., Settings], gate: Gate, ply: bytes, temp_dir: Path
) -> None:
    """What uvicorn does to requests that outlast the drain."""
    app = create_app(make_settings())
    house = app.state.house

    async def play() -> None:
        async with app.router.lifespan_context(app):
            await eventually(lambda: house.provider is not None)
            connection = Connection([ply])
            task = asyncio.create_task(app(scope_of("/filter", []), connection.receive, connection.send))
            await eventually(lambda: gate.entered == 1)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
            assert gate.stopped == 1
            assert list(temp_dir.iterdir()) == []
            assert house.admission.held == 0

    asyncio.run(play())


def test_a_slow_upload_is_given_up(make_settings: Callable[..., Settings], ply: bytes, temp_dir: Path) -> None:
    app = create_app(make_settings(transfer_seconds=0.2))

    async def play() -> None:
        async with app.router.lifespan_context(app):
            await eventually(lambda: app.state.house.provider is not None)
            connection = Connection([ply[:100]], complete=False)
            await asyncio.wait_for(app(scope_of("/filter", []), connection.receive, connection.send), 10)
            assert connection.sent[0]["status"] == 408
            assert list(temp_dir.iterdir()) == []

    asyncio.run(play())


def test_a_slow_download_is_cut(make_settings: Callable[..., Settings], ply: bytes, temp_dir: Path) -> None:
    app = create_app(make_settings(transfer_seconds=0.5))

    class Stalled(Connection):
        async def send(self, message: Any) -> None:
            await super().send(message)
            if message["type"] == "http.response.body":
                await asyncio.sleep(60)

    async def play() -> None:
        async with app.router.lifespan_context(app):
            await eventually(lambda: app.state.house.provider is not None)
            connection = Stalled([ply])
            await asyncio.wait_for(app(scope_of("/filter", []), connection.receive, connection.send), 10)
            assert not any(message.get("more_body") is False for message in connection.sent)
            assert list(temp_dir.iterdir()) == []
            assert app.state.house.admission.held == 0
            value = app.state.house.telemetry.registry.get_sample_value
            assert value("pointfilter_requests_total", {"model": "tiny", "outcome": "timeout"}) == 1

    asyncio.run(play())


def test_an_oversize_that_is_declared_is_refused_before_reading(
    make_settings: Callable[..., Settings], temp_dir: Path
) -> None:
    app = create_app(make_settings(max_upload_bytes=1000))

    async def play() -> None:
        async with app.router.lifespan_context(app):
            await eventually(lambda: app.state.house.provider is not None)
            headers = [(b"content-length", b"1001"), (b"expect", b"100-continue")]
            connection = Connection([bytes(1001)])
            await asyncio.wait_for(app(scope_of("/filter", headers), connection.receive, connection.send), 10)
            assert connection.sent[0]["status"] == 413
            assert connection._chunks, "the body was read"

    asyncio.run(play())


def test_an_oversize_in_chunks_is_refused_while_reading_and_the_rest_is_thrown_away(
    make_settings: Callable[..., Settings], temp_dir: Path
) -> None:
    app = create_app(make_settings(max_upload_bytes=1000))

    async def play() -> None:
        async with app.router.lifespan_context(app):
            await eventually(lambda: app.state.house.provider is not None)
            connection = Connection([bytes(300)] * 50)
            headers = [(b"transfer-encoding", b"chunked")]
            await asyncio.wait_for(app(scope_of("/filter", headers), connection.receive, connection.send), 10)
            assert connection.sent[0]["status"] == 413
            assert connection._chunks == []  # else the client would see a reset instead of the answer
            assert list(temp_dir.iterdir()) == []

    asyncio.run(play())


def test_in_worker_outlives_a_second_cancellation() -> None:
    running, ended = threading.Event(), threading.Event()

    def work(stop: threading.Event) -> None:
        running.set()
        stop.wait(10)
        threading.Event().wait(0.2)
        ended.set()

    async def play() -> None:
        with ThreadPoolExecutor(1) as pool:
            task = asyncio.create_task(in_worker(pool, work))
            await eventually(running.is_set)
            task.cancel()
            await asyncio.sleep(0.05)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
            assert ended.is_set()

    asyncio.run(play())


async def eventually(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    async with asyncio.timeout(seconds):
        while not condition():
            await asyncio.sleep(0.01)
