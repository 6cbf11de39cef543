"""Jobs on the disk, so that none is lost when the process is: a folder each, and a durable queue of their names.

    POINTFILTER_DATA_DIR/
        queue.db              the queues (huey's SQLite storage), unless POINTFILTER_REDIS_URL names a Redis
        incoming/<id>/        uploads that are not jobs yet
        jobs/<id>/            job.json, input.ply, output.ply, progress.json, cancel, lock

A folder becomes a job by one rename, after its files have reached the disk. job.json says what the job's state is and
is only ever replaced whole. Who works on a job, or ends it, holds its lock; the kernel frees a lock whose process died,
and a job that is queued or running while nobody holds its lock, and is not in the queue, is put into the queue again.
That, not the queue, is why none is lost. Several processes may share the folder.
"""

from __future__ import annotations

import fcntl
import logging
import os
import shutil
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from huey.storage import BaseStorage, RedisStorage, SqliteStorage

from service.errors import JobNotFoundError
from service.records import Progress, Record, State

log = logging.getLogger("service.jobs")

ID_LETTERS = frozenset("0123456789abcdef")
ID_LENGTH = 32


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

    def note(self, progress: Progress) -> None:
        """Not worth waiting for the disk."""
        _replace(self.folder / "progress.json", progress.model_dump_json().encode(), durable=False)

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
                self.write(record)
                self.source.unlink(missing_ok=True)
            return record.state.final

    def remove(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)


class Jobs:
    """All jobs of a data folder. Its methods touch the disk: call them off the event loop.

    redis: the address of a Redis for the queue, where several machines or containers share the folder.
    """

    def __init__(self, folder: Path, redis: str | None = None) -> None:
        self._incoming = folder / "incoming"
        self._folder = folder / "jobs"
        for each in (folder, self._incoming, self._folder):
            each.mkdir(mode=0o700, parents=True, exist_ok=True)
        probe = self._incoming / f".{uuid.uuid4().hex}"
        probe.touch()  # better known now than with the first upload
        probe.unlink()

        def queue(name: str) -> BaseStorage:
            if redis:
                return RedisStorage(name, url=redis, blocking=False)
            return SqliteStorage(name, str(folder / "queue.db"), fsync=True, strict_fifo=True)

        self._queues = {small: queue(f"pointfilter-{'small' if small else 'large'}") for small in (False, True)}

    def begin(self) -> Job:
        """A folder for an upload; accept it or remove it."""
        job = Job(self._incoming / uuid.uuid4().hex)
        job.folder.mkdir(mode=0o700)
        return job

    def accept(self, incoming: Job, record: Record) -> Job:
        """From here on the job survives whatever happens to the process."""
        _sync(incoming.source)
        incoming.write(record)
        job = Job(self._folder / incoming.id)
        incoming.folder.rename(job.folder)
        _sync(self._folder)
        try:
            self.requeue(record)
        except Exception:  # a Redis that is away: recover() finds the job, so it is not lost
            log.exception("a job cannot be put into the queue now")
        return job

    def find(self, name: str) -> Job:
        """Raises JobNotFoundError."""
        if len(name) != ID_LENGTH or not ID_LETTERS.issuperset(name):
            raise not_found()
        return Job(self._folder / name)

    def next(self, small: bool) -> Job | None:
        """The next job of the queue of small, or of large clouds. It may be done or gone by now: see Job.locked."""
        name = self._queues[small].dequeue()
        return None if name is None else Job(self._folder / bytes(name).decode())

    def queued(self, small: bool | None = None) -> int:
        """Jobs in one of the queues, or in both."""
        return sum(queue.queue_size() for which, queue in self._queues.items() if small in (None, which))

    def unfinished(self, owner: str | None) -> int:
        """Jobs of an owner that are queued or running."""
        return sum(not record.state.final and record.owner == owner for _, record in self.all())

    def all(self) -> Iterator[tuple[Job, Record]]:
        for folder in self._folder.iterdir():
            with suppress(JobNotFoundError, ValueError):
                yield Job(folder), Job(folder).read()

    def recover(self) -> int:
        """Puts jobs that nobody works on and that are not in the queue into it again. Returns how many."""
        queued = {bytes(name).decode() for queue in self._queues.values() for name in queue.enqueued_items()}
        found = 0
        for job, record in sorted(self.all(), key=lambda pair: pair[1].created):
            if record.state.final or record.id in queued:
                continue
            with job.locked() as free:
                if free and not job.read().state.final:
                    self.requeue(record)
                    found += 1
        return found

    def expire(self, seconds: float, upload_seconds: float) -> int:
        """Removes jobs that ended so long ago, and uploads that never became a job. Returns how many jobs."""
        now = time.time()
        for folder in self._incoming.iterdir():
            with suppress(FileNotFoundError):
                if now - folder.stat().st_mtime > upload_seconds:
                    Job(folder).remove()
        old = [job for job, record in self.all() if record.finished is not None and now - record.finished > seconds]
        for job in old:
            job.remove()
        return len(old)

    def requeue(self, record: Record) -> None:
        self._queues[record.small].enqueue(record.id.encode())

    def close(self) -> None:
        for queue in self._queues.values():
            queue.close()


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
        _sync(path.parent)


def _sync(path: Path) -> None:
    """Until a file, or the names in a folder, have reached the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
