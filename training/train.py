"""The training loop: checkpoints, log, resume. `python -m training --help` says how to run it."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from tqdm import tqdm

from training.dataset import (
    Batch,
    TrainingCloud,
    batches_ahead,
    clean_patches,
    cut_batch,
    nearest_on_surface,
    validation_cloud,
)
from training.losses import adaptive_loss, filtering_loss
from training.network import NetworkSettings, Pointfilter
from training.own import own_clouds
from training.pools import Pools
from training.settings import TrainingSettings

CHECKPOINT_VERSION = 2
STABLE = "stable.pt"  # the checkpoint from before the learning rate fell
CURVE = ("step", "loss", "distance", "validation_loss", "validation_distance")  # what a record keeps of the history


class Run:
    """A training run in a folder: checkpoint.pt (everything), stable.pt (the same before the learning rate falls),
    log.csv (the loss curve), settings.json."""

    def __init__(self, folder: Path, settings: TrainingSettings, state: dict[str, Any] | None = None) -> None:
        """state: of the checkpoint to go on from; None starts anew."""
        self.folder = folder
        self.settings = settings
        torch.manual_seed(settings.seed)
        torch.set_num_threads(settings.threads or os.cpu_count() or 1)
        self.network = Pointfilter(settings.network)
        moving_average = get_ema_multi_avg_fn(settings.ema_decay)  # type: ignore[no-untyped-call]
        self.average = AveragedModel(self.network, multi_avg_fn=moving_average, use_buffers=True)
        self.optimizer = self._optimizer()
        self.scheduler = self._scheduler()
        self.step = 0
        self.seconds = 0.0
        self.history: list[dict[str, float]] = []
        self.recent: list[tuple[float, float]] = []
        """Losses since the last row of the history."""
        self.before: list[dict[str, Any]] = []
        """Records of the runs that the first weights came from."""
        self.source: dict[str, str] = {}
        """Where the user's own data is: "meshes" or "clouds" and the folder. Empty for procedural shapes."""
        if state is not None:
            self._load(state)
        else:
            folder.mkdir(parents=True, exist_ok=True)
            for left in folder.glob("own-*.npz"):  # by a run that ended before its first checkpoint
                left.unlink()
            (folder / "settings.json").write_text(json.dumps(dataclasses.asdict(settings), indent=2) + "\n")

    def start_from(self, network: Pointfilter, before: list[dict[str, Any]]) -> None:
        """Takes over the weights of a network of the same settings, before the first step; `before` made them."""
        self.before = before
        self.network.load_state_dict(network.state_dict())
        self.average.module.load_state_dict(network.state_dict())

    def _optimizer(self) -> torch.optim.Optimizer:
        parameters, rate, decay = self.network.parameters(), self.settings.learning_rate, self.settings.weight_decay
        if self.settings.optimizer == "sgd":
            return torch.optim.SGD(parameters, rate, momentum=0.9, weight_decay=decay)
        return torch.optim.AdamW(parameters, rate, weight_decay=decay, fused=True)

    def _scheduler(self) -> torch.optim.lr_scheduler.LRScheduler:
        settings = self.settings
        if settings.schedule == "exponential":
            gamma = (settings.final_learning_rate / settings.learning_rate) ** (1 / settings.steps)
            return torch.optim.lr_scheduler.ExponentialLR(self.optimizer, gamma)

        def factor(step: int) -> float:
            return min(1.0, (step + 1) / (settings.warmup + 1), (1 - step / settings.steps) / settings.decay)

        return torch.optim.lr_scheduler.LambdaLR(self.optimizer, factor)

    def _load(self, state: dict[str, Any]) -> None:
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.scheduler.load_state_dict(state["scheduler"])
        self.step, self.seconds, self.history = state["step"], state["seconds"], state["history"]
        self.source, self.recent = state.get("source", {}), state.get("recent", [])
        self.before = state.get("before", [])

    def save(self) -> None:
        """Writes the checkpoint so that a kill at any moment leaves the old one or the new one, whole."""
        state = {
            "version": CHECKPOINT_VERSION,
            "settings": dataclasses.asdict(self.settings),
            "step": self.step,
            "seconds": self.seconds,
            "history": self.history,
            "recent": self.recent,
            "source": self.source,
            "before": self.before,
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "scheduler": self.scheduler.state_dict(),
        }
        stable = self.step == self.settings.decay_from
        for name in (STABLE, "checkpoint.pt") if stable else ("checkpoint.pt",):
            partial = self.folder / f"{name}.partial"
            with partial.open("wb") as file:
                torch.save(state, file)
                file.flush()
                os.fsync(file.fileno())
            partial.replace(self.folder / name)
        if self.history:
            partial = self.folder / "log.csv.partial"
            with partial.open("w", newline="") as text:
                writer = csv.DictWriter(text, fieldnames=list(self.history[-1]))
                writer.writeheader()
                writer.writerows(self.history)
            partial.replace(self.folder / "log.csv")

    def train(
        self,
        pools: Callable[[int], list[TrainingCloud]],
        until: int | None = None,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Trains to the last step, or stops (with a checkpoint) after step `until` or when stop() says so.

        pools: the clouds of a pool by its number, asked for one after another.
        """
        settings = self.settings
        last = settings.steps if until is None else min(until, settings.steps)
        validation = [validation_cloud(number, settings.data) for number in range(settings.validation_clouds)]
        self.network.train()
        progress = tqdm(initial=self.step, total=settings.steps, unit="batch", smoothing=0.05)
        while self.step < last and not stop():
            pool = self.step // settings.pool_steps
            if self.step == pool * settings.pool_steps and self.step:
                self.save()
            clouds = pools(pool)
            own = self._own_clouds(pool, clouds) if pool and settings.network.adaptive else []
            self._train([*clouds, *own], validation, min(last, (pool + 1) * settings.pool_steps), progress, stop)
        progress.close()
        self.save()

    def _train(
        self,
        clouds: list[TrainingCloud],
        validation: list[TrainingCloud],
        last: int,
        progress: tqdm[Any],
        stop: Callable[[], bool],
    ) -> None:
        settings = self.settings
        bfloat16 = _use_bfloat16(settings.precision)
        started = time.perf_counter()
        spent = self.seconds
        for batch in batches_ahead(clouds, settings.data, self.step, last):
            if stop():
                break
            with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
                loss, distance = self._loss(self.network, batch, clouds, self.step)
            self.optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            if settings.gradient_clip:
                torch.nn.utils.clip_grad_norm_(self.network.parameters(), settings.gradient_clip)
            self.optimizer.step()
            self.scheduler.step()
            self.average.update_parameters(self.network)
            self.step += 1
            self.seconds = spent + time.perf_counter() - started
            self.recent.append((loss.item(), distance))
            progress.update()
            if self.step % settings.validate_every == 0 or self.step == settings.steps:
                losses = np.mean(self.recent, axis=0)
                row: dict[str, float] = {
                    "step": self.step,
                    "patches": self.step * settings.data.batch,
                    "hours": round(self.seconds / 3600, 4),
                    "patches_per_second": round(self.step * settings.data.batch / self.seconds, 1),
                    "learning_rate": float(self.scheduler.get_last_lr()[0]),
                    "loss": float(losses[0]),
                    "distance": float(losses[1]),
                    **self._validate(validation),
                }
                self.recent.clear()
                self.history.append(row)
                progress.write("  ".join(f"{name} {value:.6g}" for name, value in row.items()))
            if self.step % settings.checkpoint_every == 0 or self.step == settings.decay_from:
                self.save()

    def _loss(
        self, network: Pointfilter, batch: Batch, clouds: list[TrainingCloud], step: int
    ) -> tuple[torch.Tensor, float]:
        """The mean loss of a batch, and the mean distance to the surface that is left, in units of the radius."""
        settings = self.settings
        if not network.settings.adaptive:
            displacements = network(batch.patches)
            near = clean_patches(batch, clouds, settings.data, step)
            loss = filtering_loss(displacements, *near, settings.loss, progress=step / settings.steps)
            return loss.mean(), loss.mean().item()
        answers = network.answer(batch.patches, batch.queries, batch.owners, batch.context, batch.counts)
        moved = batch.queries + answers.displacements
        nearest, normals, spacing = nearest_on_surface(batch, clouds, moved)
        loss, left = adaptive_loss(answers, nearest, normals, batch.still, batch.queries, spacing, settings.loss)
        return loss.mean(), left.mean().item()

    def _own_clouds(self, pool: int, clouds: list[TrainingCloud]) -> list[TrainingCloud]:
        """Pieces of the clouds of a pool, filtered by the network of its first step."""
        return own_clouds(self.folder / f"own-{pool}.npz", clouds, self._trained(), self.settings.data)

    def _trained(self) -> Pointfilter:
        """The weights that are exported, not to be trained."""
        average = cast("Pointfilter", self.average.module) if self.settings.ema_decay else self.network
        network = Pointfilter(self.settings.network)
        network.load_state_dict(average.state_dict())
        return network.eval()

    def _validate(self, clouds: list[TrainingCloud]) -> dict[str, float]:
        """The averaged network on shapes it never saw: its loss, and the distance that it leaves."""
        if not clouds:
            return {}
        data = dataclasses.replace(self.settings.data, batch=512, clouds_per_batch=4 * len(clouds), seed=2**31)
        batch = cut_batch(clouds, data, 0)
        with torch.inference_mode():
            loss, distance = self._loss(self._trained(), batch, clouds, self.step)
        return {"validation_loss": loss.item(), "validation_distance": distance}


def trained_network(state: dict[str, Any]) -> Pointfilter:
    """The network of a checkpoint as it is exported: the averaged weights, unless the run kept none."""
    network = Pointfilter(NetworkSettings.from_dict(state["settings"]["network"]))
    weights = state["network"]
    if state["settings"]["ema_decay"]:
        prefix = "module."
        weights = {key.removeprefix(prefix): value for key, value in state["average"].items() if key.startswith(prefix)}
    network.load_state_dict(weights)
    return network.eval()


def training_record(state: dict[str, Any]) -> dict[str, Any]:
    """How the weights of a checkpoint came about, the runs that they started from included, the first one first."""
    return {
        "settings": state["settings"],
        "steps": state["step"],
        "patches": state["step"] * state["settings"]["data"]["batch"],
        "hours": round(state["seconds"] / 3600, 3),
        "curve": [{key: row[key] for key in CURVE if key in row} for row in state["history"]],
        "before": state.get("before", []),
    }


def _use_bfloat16(precision: str) -> bool:
    if precision == "auto":
        return bool(torch.cpu._is_amx_tile_supported() or torch.cpu._is_avx512_bf16_supported())
    return precision == "bfloat16"


def _of_another_length(
    folder: Path, saved: dict[str, Any], settings: TrainingSettings, steps: int
) -> tuple[dict[str, Any], TrainingSettings]:
    """The checkpoint and the settings with which a run goes on to another number of steps."""
    longer = dataclasses.replace(settings, steps=steps)
    if saved["step"] > min(settings.decay_from, longer.decay_from) and (folder / STABLE).exists():
        saved = torch.load(folder / STABLE, weights_only=True)
    if saved["step"] > min(settings.decay_from, longer.decay_from):
        raise ValueError(
            f"a run of {steps} steps lowers its learning rate from step {longer.decay_from} on, one of "
            f"{settings.steps} from step {settings.decay_from} on: the checkpoint of step {saved['step']} is too late"
        )
    return saved, longer


def start(
    folder: Path,
    settings: TrainingSettings,
    *,
    resume: bool = False,
    meshes: Path | None = None,
    clouds: Path | None = None,
    init: dict[str, Any] | None = None,
    until: int | None = None,
    steps: int | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Run:
    """Starts or resumes a run and trains it to its end (or to step `until`, or until stop(), asked between batches).

    steps: another length for a run that is resumed; the result is that of a run with this length from the start.
    init: the checkpoint where the weights come from. Raises ValueError where its network has other settings,
    FileExistsError where the folder holds another run, KeyboardInterrupt when stopped before the first batch.
    """
    first = None if init is None else trained_network(init)
    saved = None
    if resume:
        saved = torch.load(folder / "checkpoint.pt", weights_only=True)
        settings = TrainingSettings.from_dict(saved["settings"])
        if steps is not None:
            saved, settings = _of_another_length(folder, saved, settings, steps)
    elif (folder / "checkpoint.pt").exists():
        raise FileExistsError(f"{folder} holds a run already: go on with --resume, or choose another folder with --out")
    if first is not None:
        if resume:
            raise ValueError("weights to start from are for a new run; this one goes on from its own checkpoint")
        if first.settings != settings.network:
            raise ValueError(f"the weights to start from do not fit the network: {first.settings}, {settings.network}")
    run = Run(folder, settings, saved)
    if meshes or clouds or not resume:
        run.source = {name: str(path.absolute()) for name, path in (("meshes", meshes), ("clouds", clouds)) if path}
    meshes, clouds = (Path(run.source[name]) if name in run.source else None for name in ("meshes", "clouds"))
    if init is not None and first is not None:
        record = training_record(init)
        run.start_from(first, [*record.pop("before"), record])
    last = settings.steps if until is None else min(until, settings.steps)
    count = -(-last // settings.pool_steps)
    with Pools(settings.data, count, meshes=meshes, clouds=clouds, stop=stop) as pools:
        run.train(pools, until, stop)
    return run
