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

import logging
import time
import uuid
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from huey.storage import BaseStorage, RedisStorage, SqliteStorage

from service.errors import JobNotFoundError
from service.job import Job, not_found, sync
from service.records import Record, State

log = logging.getLogger("service.jobs")

ID_LETTERS = frozenset("0123456789abcdef")
ID_LENGTH = 32


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
        sync(incoming.source)
        incoming.write(record)
        job = Job(self._folder / incoming.id)
        incoming.folder.rename(job.folder)
        sync(self._folder)
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

    def queued(self, small: bool) -> int:
        """Names in a queue, those of jobs that were cancelled meanwhile too."""
        size: int = self._queues[small].queue_size()
        return size

    def waiting(self) -> int:
        """Jobs that are queued."""
        return sum(record.state is State.QUEUED for _, record in self.all())

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

    def remove(self, job: Job) -> None:
        """In one step, so that no half of a job is left where jobs lie."""
        away = self._incoming / uuid.uuid4().hex
        with suppress(FileNotFoundError):
            job.folder.rename(away)
            Job(away).remove()

    def expire(self, seconds: float, upload_seconds: float) -> int:
        """Removes jobs that ended so long ago, and uploads that never became a job. Returns how many jobs."""
        now = time.time()
        for folder in self._incoming.iterdir():
            with suppress(FileNotFoundError):
                if now - folder.stat().st_mtime > upload_seconds:
                    Job(folder).remove()
        old = [job for job, record in self.all() if record.finished is not None and now - record.finished > seconds]
        for job in old:
            self.remove(job)
        return len(old)

    def requeue(self, record: Record) -> None:
        self._queues[record.small].enqueue(record.id.encode())

    def close(self) -> None:
        for queue in self._queues.values():
            queue.close()
