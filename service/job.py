"""A job's folder: its record, its files and its lock."""

from __future__ import annotations

import fcntl
import os
import shutil
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from service.errors import JobNotFoundError
from service.records import Progress, Record, State

PROGRESS_SECONDS = 0.5  # how often it is written down


class Job:
    """A folder under jobs/ (or incoming/, as long as its file is still on its way)."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.source = folder / "input.ply"
        self.target = folder / "output.ply"

    @property
    def id(self) -> str:
        return self.folder.name

    def read(self) -> Record:
        """Raises JobNotFoundError."""
        try:
            return Record.model_validate_json((self.folder / "job.json").read_bytes())
        except (FileNotFoundError, NotADirectoryError):
            raise not_found() from None

    def write(self, record: Record) -> None:
        _replace(self.folder / "job.json", record.model_dump_json().encode())

    def progress(self) -> Progress | None:
        with suppress(OSError, ValueError):
            return Progress.model_validate_json((self.folder / "progress.json").read_bytes())
        return None

    def progress_writer(self) -> Callable[[int, int, int], None]:
        """What work.carry_out calls; writes down how far it is, now and then, and does not wait for the disk."""
        started = time.monotonic()
        written = float("-inf")

        def write(done: int, total: int, points: int) -> None:
            nonlocal written
            now = time.monotonic()
            if now - written >= PROGRESS_SECONDS:
                written = now
                progress = Progress(done=done, total=total, points=points, seconds=now - started)
                with suppress(OSError):  # removed, or the disk is full: the work itself will tell
                    _replace(self.folder / "progress.json", progress.model_dump_json().encode(), durable=False)

        return write

    def ask_to_cancel(self) -> None:
        """Whoever works on it looks for this."""
        with suppress(FileNotFoundError):
            (self.folder / "cancel").touch()

    def to_be_cancelled(self) -> bool:
        return (self.folder / "cancel").exists() or not self.folder.exists()

    @contextmanager
    def locked(self) -> Iterator[bool]:
        """Whether the lock could be had at once. Another process's, or another thread's, counts alike."""
        try:
            descriptor = os.open(self.folder / "lock", os.O_RDWR | os.O_CREAT, 0o600)
        except FileNotFoundError:
            yield False
            return
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                yield False
                return
            yield True
        finally:
            os.close(descriptor)

    def end_if_free(self) -> bool:
        """Whether the job is over; one that nobody works on is cancelled by this."""
        with self.locked() as free:
            record = self.read()
            if free and not record.state.final:
                record = record.model_copy(update={"state": State.CANCELLED, "finished": time.time()})
                self.conclude(record)
            return record.state.final

    def conclude(self, record: Record) -> None:
        """Writes down how the job ended, and removes what it needs no longer and what a killed worker left.

        The record first: a job whose files are gone would be a lost one.
        """
        kept = {"job.json", "lock", "progress.json"} | ({"output.ply"} if record.state is State.DONE else set())
        with suppress(FileNotFoundError):  # removed meanwhile
            self.write(record)
            for path in self.folder.iterdir():
                if path.name not in kept:
                    path.unlink(missing_ok=True)

    def remove(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)


def not_found() -> JobNotFoundError:
    return JobNotFoundError("there is no job of this name, or it expired")


def _replace(path: Path, data: bytes, durable: bool = True) -> None:
    """Writes a file that is there whole or not at all."""
    partial = path.with_name(f".{uuid.uuid4().hex}")
    try:
        with os.fdopen(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(data)
            if durable:
                file.flush()
                os.fsync(file.fileno())
        partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise
    if durable:
        sync(path.parent)


def sync(path: Path) -> None:
    """Until a file, or the names in a folder, have reached the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
