"""What the routes of one app share, and its life: starting, ready, draining, closed."""

from __future__ import annotations

import asyncio
import logging
import os
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

from service.admission import Admission
from service.engines import Engines
from service.errors import DrainingError, NotReadyError
from service.settings import Settings
from service.telemetry import Telemetry

log = logging.getLogger("service")

RETRY_SECONDS = 2  # loading the default model takes about this long


class House:
    """One app's state."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.admission = Admission(settings.workers, settings.queue_size)
        self.telemetry = Telemetry(self.admission)
        self.engines = Engines(settings, self.telemetry.models_loaded)
        self.workers = ThreadPoolExecutor(settings.workers, thread_name_prefix="worker")
        self.draining = False
        self.provider: str | None = None
        """Of the default model, once it has answered."""
        self.failure: str | None = None
        """Why the default model cannot be used. For the log only: it may name paths."""
        self.on_failure: Callable[[], None] = lambda: None
        """What `python -m service` does about it: it ends."""
        self._loading: asyncio.Task[None] | None = None

    def open(self) -> None:
        """Starts loading the default model; returns at once."""
        self._loading = asyncio.create_task(self._load())

    async def close(self) -> None:
        """Waits until no thread works any more."""
        self.draining = True
        if self._loading:
            await asyncio.wait([self._loading])
        await asyncio.to_thread(self.workers.shutdown, wait=True, cancel_futures=True)

    async def _load(self) -> None:
        try:
            self.provider = await asyncio.to_thread(self._prepare)
        except Exception as error:  # noqa: BLE001 - whatever it is, the service must say so and not become ready
            self.failure = f"{type(error).__name__}: {error}"
            log.critical("the service cannot become ready: %s", self.failure, extra={"model": self.settings.model})
            self.on_failure()
        else:
            log.info("ready", extra={"model": self.settings.model, "provider": self.provider})

    def _prepare(self) -> str:
        with tempfile.TemporaryDirectory(prefix="pointfilter-", dir=self.settings.temp_dir) as folder:
            os.statvfs(folder)  # an upload needs a folder that can be written to: better known now
        return self.engines.engine(self.settings.model).provider

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
