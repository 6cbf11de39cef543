"""A worker as the service holds it."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection

from service import worker
from service.settings import Settings


@dataclass
class Hand:
    """A worker: our end of its connection, what is in its memory, and how to end it at once."""

    connection: Connection
    kill: Callable[[], None]
    pid: int | None = None
    loaded: tuple[worker.Loaded, ...] = ()

    def end(self) -> None:
        """Whatever state it is in."""
        self.connection.close()
        with suppress(OSError, ValueError):
            self.kill()


def start_process(settings: Settings) -> Hand:
    """A worker in a process of its own."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=worker.run_process, args=(theirs, settings), name="worker", daemon=True)
    process.start()
    theirs.close()  # so that its death ends the connection

    def kill() -> None:
        process.kill()
        process.join()
        process.close()

    return Hand(ours, kill, process.pid)
