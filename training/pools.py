"""The clouds of a run, one pool after another; a process of its own makes the next one while the network trains."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from types import TracebackType

from tqdm import tqdm

from training.dataset import DataSettings, TrainingCloud, cloud_from_mesh, load_author_clouds
from training.shapes import Mesh, load_meshes, random_shape


class Pools:
    """pools(number) are the clouds of that pool: from the authors' layout (always the same), from the user's meshes, or
    procedural (the default), each with a shape, a density and a noise of its own."""

    def __init__(
        self,
        settings: DataSettings,
        count: int = 1,
        *,
        meshes: Path | None = None,
        clouds: Path | None = None,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """count: of the pools of the whole run. stop: asked between clouds."""
        self._settings, self._count, self._stop = settings, count, stop
        self._meshes = load_meshes(meshes) if meshes is not None else []
        self._given = load_author_clouds(clouds, settings.radius) if clouds is not None else []
        self._executor: ProcessPoolExecutor | None = None
        self._ahead: list[Future[TrainingCloud]] = []
        self._ahead_of = 0

    def __enter__(self) -> Pools:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._executor is not None:
            self._executor.shutdown(wait=False, cancel_futures=True)

    def __call__(self, number: int) -> list[TrainingCloud]:
        """Raises KeyboardInterrupt when stopped."""
        if self._given:
            return self._given
        pool = []
        for cloud in tqdm(self._clouds(number), total=self._settings.clouds, unit="cloud", desc=f"pool {number}"):
            if self._stop():
                raise KeyboardInterrupt
            pool.append(cloud)
        self._ahead = []
        if number + 1 < self._count:
            self._start(number + 1)
        return pool

    def _start(self, number: int) -> None:
        if self._executor is None:
            self._executor = ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_ignore_interrupts)
        self._ahead_of = number
        self._ahead = [self._executor.submit(training_cloud, self._settings, *task) for task in self._tasks(number)]

    def _clouds(self, number: int) -> Iterator[TrainingCloud]:
        if self._ahead and self._ahead_of == number:
            for future in self._ahead:
                yield future.result()
        else:
            for task in self._tasks(number):
                yield training_cloud(self._settings, *task)

    def _tasks(self, number: int) -> Iterator[tuple[int, Mesh | None]]:
        """Seed and mesh, if given, of each cloud."""
        for cloud in range(number * self._settings.clouds, (number + 1) * self._settings.clouds):
            mesh = self._meshes[cloud % len(self._meshes)] if self._meshes else None
            yield self._settings.seed * 10_000 + cloud, mesh


def training_cloud(settings: DataSettings, seed: int, mesh: Mesh | None = None) -> TrainingCloud:
    """The cloud of a seed, of a random shape unless a mesh is given."""
    return cloud_from_mesh(mesh or random_shape(seed), settings, seed)


def _ignore_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it goes to every process of a terminal; the run handles it
