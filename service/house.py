"""What the routes of one app share, and its life: starting, ready, draining, closed."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from service.admission import Admission
from service.crew import Crew
from service.engines import Engines
from service.errors import DrainingError, NotReadyError, WorkerDiedError
from service.jobs import Jobs
from service.keys import Keys
from service.runner import Runner
from service.settings import Settings
from service.telemetry import Telemetry

log = logging.getLogger("service")

RETRY_SECONDS = 2  # loading the default model takes about this long
MEND_SECONDS = 1.0  # how often dead workers are looked for


class House:
    """One app's state."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        express = 1 if settings.small_points else 0
        self.admission = Admission(settings.workers, settings.queue_size, express, settings.places_per_key)
        self.telemetry = Telemetry(self.admission, settings.model)
        self.engines = Engines(settings)
        """For looking at bundles; the workers have engines of their own."""
        self.crew = Crew(
            settings,
            settings.workers + express,
            on_models=self.telemetry.models_loaded,
            on_failure=self._fail,
            on_death=self.telemetry.worker_died,
        )
        self.executor = ThreadPoolExecutor(settings.workers + express, thread_name_prefix="follows-a-worker")
        self.provider: str | None = None
        """Of the default model, once it has answered."""
        self.failure: str | None = None
        """Why the default model cannot be used. For the log only: it may name paths."""
        self.on_failure: Callable[[], None] = lambda: None
        """What `python -m service` does about it: it ends."""
        self._drain_until: float | None = None
        self._loading: asyncio.Task[None] | None = None
        self._mending: asyncio.Task[None] | None = None
        self._jobs: Jobs | None = None
        self._keys: Keys | None = None
        self._runner: Runner | None = None

    @property
    def draining(self) -> bool:
        return self._drain_until is not None

    def drain(self) -> None:
        """From now on takes nothing new, and what is under way has drain_seconds."""
        if self._drain_until is None:
            self._drain_until = time.monotonic() + self.settings.drain_seconds

    def _left(self) -> float:
        """Seconds until what is under way must end."""
        return max(0.0, (self._drain_until or 0.0) - time.monotonic())

    @property
    def jobs(self) -> Jobs:
        """Once check_started() has passed."""
        assert self._jobs is not None  # noqa: S101 - routes depend on Ready
        return self._jobs

    @property
    def runner(self) -> Runner:
        """Once check_started() has passed."""
        assert self._runner is not None  # noqa: S101
        return self._runner

    @property
    def keys(self) -> Keys:
        """Once check_started() has passed."""
        assert self._keys is not None  # noqa: S101
        return self._keys

    def open(self) -> None:
        """Starts the workers, which load the default model; returns at once."""
        self._loading = asyncio.create_task(self._load())

    async def close(self) -> None:
        """Waits until nobody works any more."""
        self.drain()
        if self._loading:
            await asyncio.wait([self._loading], timeout=self._left())
            if not self._loading.done():
                await asyncio.to_thread(self.crew.close)  # ends the start of a worker, however long it would take
                await asyncio.wait([self._loading])
        if self._mending:
            self._mending.cancel()
        if self._runner:
            await self._runner.close(self._left())
        await asyncio.to_thread(self.executor.shutdown, wait=True, cancel_futures=True)
        await asyncio.to_thread(self.crew.close)
        if self._jobs:
            await asyncio.to_thread(self._jobs.close)

    async def _load(self) -> None:
        try:
            provider = await asyncio.to_thread(self._prepare)
        except Exception as error:  # noqa: BLE001 - whatever it is, the service must say so and not become ready
            if not self.draining:
                self._fail(error)
            return
        self._runner = Runner(
            self.jobs, self.settings, self.admission, self.telemetry, self.executor, self.crew.carry_out,
            lambda: self.draining,
        )  # fmt: skip
        self.telemetry.watch(lambda: self.runner.waiting, lambda: self.runner.running, self.crew.memory)
        if not self.draining:
            self._runner.open()
        self._mending = asyncio.create_task(self._mend())
        self.provider = provider
        log.info("ready", extra={"model": self.settings.model, "provider": provider})

    def _prepare(self) -> str:
        """Returns the default model's provider."""
        with tempfile.TemporaryDirectory(prefix="pointfilter-", dir=self.settings.temp_dir) as folder:
            os.statvfs(folder)  # an upload needs a folder that can be written to: better known now
        self._keys = Keys(self.settings.keys_file)
        self._jobs = Jobs(self.settings.job_folder, self.settings.redis_url)
        self.crew.open()
        return self.crew.loaded()[0].provider

    async def _mend(self) -> None:
        while True:
            await asyncio.sleep(MEND_SECONDS)
            with contextlib.suppress(WorkerDiedError):
                await asyncio.to_thread(self.crew.mend)

    def _fail(self, error: Exception) -> None:
        self.failure = f"{type(error).__name__}: {error}"
        log.critical("the service cannot work: %s", self.failure, extra={"model": self.settings.model})
        self.on_failure()

    def check_alive(self) -> None:
        """Raises NotReadyError when only a new process can help."""
        if self.failure or (self._runner and not self._runner.alive) or (self._mending and self._mending.done()):
            raise NotReadyError("the workers are gone and cannot be replaced", hint="start the process again")

    def check_ready(self) -> None:
        """Raises NotReadyError, DrainingError."""
        if self.draining:
            raise DrainingError("this process is about to end and takes no new requests", retry_after=RETRY_SECONDS)
        self.check_started()

    def check_started(self) -> None:
        """Raises NotReadyError."""
        if self.failure:
            raise NotReadyError(
                "the default model failed to load", hint="see the log of the service", retry_after=10 * RETRY_SECONDS
            )
        if not self.provider:
            raise NotReadyError("the default model has not answered its first inference yet", retry_after=RETRY_SECONDS)
