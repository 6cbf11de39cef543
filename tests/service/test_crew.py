"""Workers: they die, hang and refuse to start, and the service goes on."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

import service.crew
from pointfilter import PointCloud
from pointfilter.errors import FilteringCancelledError, InvalidModelError, MalformedFileError, UnsupportedFormatError
from service import worker
from service.app import create_app
from service.crew import Crew
from service.errors import WorkerDiedError
from service.hands import Hand
from service.settings import Settings
from service.work import Order
from tests.service.apps import Gate, house_of, metric, start_thread, until

ORDER = Order("tiny", 1, None, 0, "same")
LONG = Order("tiny", 10, None, 0, "same")


@pytest.fixture
def crew(make_settings: Callable[..., Settings]) -> Iterator[Crew]:
    """One worker."""
    crew = Crew(make_settings(), 1)
    crew.open()
    yield crew
    crew.close()


@pytest.fixture
def source(tmp_path: Path, ply: bytes) -> Path:
    path = tmp_path / "input.ply"
    path.write_bytes(ply)
    return path


@pytest.fixture(scope="module")
def long_source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cloud that takes seconds."""
    path = tmp_path_factory.mktemp("long") / "long.ply"
    PointCloud(np.random.default_rng(0).uniform(size=(20_000, 3))).write(path)
    return path


def pid(crew: Crew) -> int:
    (hand,) = crew._hands
    assert hand.pid
    return hand.pid


@pytest.mark.processes
def test_work_is_done_in_another_process(crew: Crew, source: Path, tmp_path: Path) -> None:
    seen: list[tuple[int, int, int]] = []
    delivery = crew.carry_out(ORDER, source, tmp_path / "out.ply", threading.Event(), lambda *now: seen.append(now))
    assert pid(crew) != os.getpid()
    assert delivery.size == (tmp_path / "out.ply").stat().st_size
    assert delivery.report.points == 500
    assert seen[0] == (0, 500, 500)
    assert seen[-1] == (500, 500, 500)
    assert [(model.name, model.provider) for model in crew.loaded()] == [("tiny", "CPUExecutionProvider")]


@pytest.mark.processes
def test_errors_come_back_as_they_are(crew: Crew, source: Path, tmp_path: Path) -> None:
    source.write_bytes(b"ply\nformat ascii 1.0\nelement vertex 5\n")
    with pytest.raises(MalformedFileError) as caught:
        crew.carry_out(ORDER, source, tmp_path / "out.ply", threading.Event())
    assert caught.value.message
    assert "carry_out" in caught.value.__notes__[0]  # where it was raised, for the log
    source.write_bytes(b"no ply")
    with pytest.raises(UnsupportedFormatError):
        crew.carry_out(ORDER, source, tmp_path / "out.ply", threading.Event())
    with pytest.raises(FileNotFoundError):  # an error of the system is not the worker's end
        crew.carry_out(ORDER, tmp_path / "nothing.ply", tmp_path / "out.ply", threading.Event())
    assert list(tmp_path.glob("out*")) == []


@pytest.mark.processes
def test_a_worker_that_dies_at_work_is_replaced_and_its_work_done_again(
    crew: Crew, long_source: Path, tmp_path: Path
) -> None:
    expected, killed = tmp_path / "expected.ply", tmp_path / "killed.ply"
    crew.carry_out(LONG, long_source, expected, threading.Event())
    first = pid(crew)
    once = threading.Event()

    def progress(done: int, _total: int, _points: int) -> None:
        if done and not once.is_set():
            once.set()
            os.kill(first, signal.SIGKILL)

    crew.carry_out(LONG, long_source, killed, threading.Event(), progress)
    assert once.is_set()
    assert pid(crew) != first
    assert killed.read_bytes() == expected.read_bytes()


@pytest.mark.processes
def test_a_file_that_kills_every_worker_is_given_up(
    crew: Crew, long_source: Path, source: Path, tmp_path: Path
) -> None:
    killed: set[int] = set()

    def progress(done: int, _total: int, _points: int) -> None:
        if done and (now := pid(crew)) not in killed:
            killed.add(now)
            os.kill(now, signal.SIGKILL)

    with pytest.raises(WorkerDiedError) as caught:
        crew.carry_out(LONG, long_source, tmp_path / "out.ply", threading.Event(), progress)
    assert caught.value.limit == len(killed) == service.crew.ATTEMPTS
    crew.carry_out(ORDER, source, tmp_path / "out.ply", threading.Event())  # the next one is served


@pytest.mark.processes
def test_a_worker_that_does_not_stop_is_killed(crew: Crew, long_source: Path, source: Path, tmp_path: Path) -> None:
    """It hangs, as a worker in foreign code may: here it is frozen."""
    first = pid(crew)
    stop = threading.Event()
    told: list[float] = []

    def progress(done: int, _total: int, _points: int) -> None:
        if done and not stop.is_set():
            os.kill(first, signal.SIGSTOP)
            told.append(time.monotonic())
            stop.set()

    with pytest.raises(FilteringCancelledError):
        crew.carry_out(LONG, long_source, tmp_path / "out.ply", stop, progress)
    assert time.monotonic() - told[0] < 1.0
    crew.carry_out(ORDER, source, tmp_path / "out.ply", threading.Event())
    assert pid(crew) != first


@pytest.mark.processes
def test_a_free_worker_that_dies_is_replaced(crew: Crew) -> None:
    first = pid(crew)
    crew.mend()
    assert pid(crew) == first
    os.kill(first, signal.SIGKILL)
    until(lambda: (crew.mend(), len(crew._hands) == 1 and pid(crew) != first)[1])  # type: ignore[func-returns-value]


@pytest.mark.processes
def test_workers_end_with_the_service(crew: Crew) -> None:
    """As after a kill -9 of the service: all that a worker sees of it is the end of its connection."""
    (hand,) = crew._hands
    number = pid(crew)
    hand.connection.close()
    until(lambda: not Path(f"/proc/{number}/cmdline").exists() or not Path(f"/proc/{number}/cmdline").read_bytes())


def test_a_model_that_cannot_be_used_is_known_at_the_start(make_settings: Callable[..., Settings]) -> None:
    crew = Crew(make_settings(model="broken"), 2)
    with pytest.raises(InvalidModelError):
        crew.open()
    crew.close()


def test_a_worker_that_says_nothing_is_not_waited_for(
    make_settings: Callable[..., Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Mute:
        def poll(self, _: float) -> bool:
            return False

        def close(self) -> None:
            pass

    monkeypatch.setattr(service.crew, "start_process", lambda _: Hand(Mute(), lambda: None))  # type: ignore[arg-type]
    crew = Crew(make_settings(), 1)
    with pytest.raises(WorkerDiedError):
        crew.open()


def test_an_error_that_cannot_travel_is_told_in_words() -> None:
    class Local(Exception):  # noqa: N818
        pass

    found = worker._portable(Local("what happened"))
    assert type(found) is RuntimeError
    assert str(found) == "Local: what happened"


def test_without_a_new_worker_the_service_says_so(
    make_settings: Callable[..., Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Live is false, and the process ends, when only a new process can help."""
    ends: list[Callable[[], None]] = []

    def start(settings: Settings) -> Hand:
        hand = start_thread(settings)
        ends.append(hand.connection.close)
        return hand

    monkeypatch.setattr(service.crew, "start_process", start)
    app = create_app(make_settings())
    failed = threading.Event()
    app.state.house.on_failure = failed.set
    with TestClient(app) as client:
        until(lambda: client.get("/health/ready").status_code == 200)
        assert client.get("/health/live").status_code == 200

        def no_more(_: Settings) -> Hand:
            raise OSError(11, "Resource temporarily unavailable")

        monkeypatch.setattr(service.crew, "start_process", no_more)
        ends[0]()
        until(failed.is_set)
        assert client.get("/health/live").status_code == 503
        assert metric(client, "pointfilter_worker_deaths_total") >= 1


def test_a_small_cloud_does_not_wait_for_a_large_one(
    make_client: Callable[..., TestClient], gate: Gate, ply: bytes, cloud: PointCloud, tmp_path: Path
) -> None:
    client = make_client(workers=1, small_points=len(cloud))
    PointCloud(np.vstack([cloud.xyz, cloud.xyz[:1] + 0.01])).write(tmp_path / "large.ply")
    large = (tmp_path / "large.ply").read_bytes()
    with ThreadPoolExecutor(3) as pool:

        def send(body: bytes) -> Future[Any]:
            return pool.submit(client.post, "/filter", content=body)

        first = send(large)
        until(lambda: gate.entered == 1)
        second = send(large)
        until(lambda: house_of(client).admission.waiting == 1)
        small = send(ply)
        until(lambda: gate.entered == 2)
        assert house_of(client).admission.waiting == 1  # the second large one
        gate.open.set()
        assert [each.result().status_code for each in (first, second, small)] == [200] * 3
