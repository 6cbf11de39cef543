"""A worker: does one request's work at a time, in a process of its own, so that it can be stopped, or die, alone.

The messages below are all that passes between it and the service (crew.py). The end of the connection ends it.
"""

from __future__ import annotations

import os
import pickle
import signal
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue

from pointfilter.engine import Engine
from pointfilter.inspection import Look
from service.engines import Engines
from service.exchange import current_request_id
from service.logs import configure_logging
from service.settings import Settings
from service.work import Delivery, LookOrder, Order, carry_out, look_over

PROGRESS_SECONDS = 0.1  # how often it says how far it is
OUT_OF_MEMORY_SCORE = 500  # the kernel is to take a worker before it takes the service


@dataclass(frozen=True)
class Task:
    """To the worker. target: where the filtered file goes; None for a LookOrder. request_id: for its log."""

    order: Order | LookOrder
    source: Path
    target: Path | None
    request_id: str | None


@dataclass(frozen=True)
class Stop:
    """To the worker: what it is at need not be finished."""


@dataclass(frozen=True)
class Loaded:
    """A model in a worker's memory."""

    name: str
    version: str
    sha256: str
    provider: str


@dataclass(frozen=True)
class Up:
    """From the worker: the default model has answered."""

    loaded: tuple[Loaded, ...]


@dataclass(frozen=True)
class Progress:
    """From the worker: done and total in units of points times iterations, and the points that are filtered."""

    done: int
    total: int
    points: int


@dataclass(frozen=True)
class Done:
    """From the worker."""

    result: Delivery | Look
    """A Look for a LookOrder."""
    loaded: tuple[Loaded, ...]


@dataclass(frozen=True)
class Failed:
    """From the worker; what its work raised. First of all messages: the default model cannot be used."""

    error: Exception


def run_process(connection: Connection, settings: Settings) -> None:
    """The main function of a worker's process."""
    for number in (signal.SIGINT, signal.SIGTERM):  # meant for the service, which says when to end
        signal.signal(number, signal.SIG_IGN)
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(OUT_OF_MEMORY_SCORE))
    configure_logging(settings)
    # Nobody is left to work for when the service is gone: what is under way must not go on for minutes.
    run(connection, settings, lambda: os._exit(0))


def run(connection: Connection, settings: Settings, on_end: Callable[[], None] = lambda: None) -> None:
    """Works until the connection ends, then calls on_end() from another thread."""
    stop = threading.Event()
    inbox: SimpleQueue[Task | None] = SimpleQueue()

    def listen() -> None:
        while True:
            try:
                message = connection.recv()
            except (EOFError, OSError):
                stop.set()
                inbox.put(None)
                on_end()
                return
            if isinstance(message, Task):
                stop.clear()  # a Stop that came too late was for the task before
                inbox.put(message)
            else:
                stop.set()

    threading.Thread(target=listen, name="orders", daemon=True).start()
    engines = Engines(settings)
    with suppress(BrokenPipeError):
        try:
            engines.engine(settings.model)
        except Exception as error:  # noqa: BLE001 - whatever it is, the service must know
            connection.send(Failed(_portable(error)))
            return
        connection.send(Up(_loaded(engines)))
        while (task := inbox.get()) is not None:
            connection.send(_answer(task, connection, engines, settings, stop))


def _answer(
    task: Task, connection: Connection, engines: Engines, settings: Settings, stop: threading.Event
) -> Done | Failed:
    token = current_request_id.set(task.request_id)

    told = float("-inf")

    def progress(done: int, total: int, points: int) -> None:
        nonlocal told
        if time.monotonic() - told >= PROGRESS_SECONDS or done == total:
            told = time.monotonic()
            connection.send(Progress(done, total, points))

    try:
        result = _result(task, engines, settings, stop, progress)
    except Exception as error:  # noqa: BLE001 - it goes to whoever asked
        return Failed(_portable(error))
    finally:
        current_request_id.reset(token)
    return Done(result, _loaded(engines))


def _result(
    task: Task,
    engines: Engines,
    settings: Settings,
    stop: threading.Event,
    progress: Callable[[int, int, int], None],
) -> Delivery | Look:
    """Raises what the work raises."""
    if isinstance(task.order, LookOrder):
        return look_over(task.order, task.source, engines.engine, settings.read_limits, stop.is_set)
    assert task.target is not None  # noqa: S101 - an Order has one
    return carry_out(task.order, task.source, task.target, engines.engine, settings.read_limits, stop.is_set, progress)


def _loaded(engines: Engines) -> tuple[Loaded, ...]:
    def described(engine: Engine) -> Loaded:
        bundle = engine.bundle
        return Loaded(bundle.name, bundle.version, bundle.sha256, engine.provider)

    return tuple(described(engine) for engine in engines.loaded())


def _portable(error: Exception) -> Exception:
    """The error with its traceback as a note; a RuntimeError in its place when it cannot travel."""
    text = "".join(traceback.format_exception(error))
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301 - our own, a moment ago
    except Exception:  # noqa: BLE001 - classes of libraries may do anything here
        error = RuntimeError(f"{type(error).__name__}: {error}")
    error.add_note(text)
    return error
