"""The settings of a training run, checked when they are made."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from training.dataset import DataSettings
from training.losses import LOSSES, LossSettings
from training.network import NetworkSettings

OPTIMIZERS = ("adamw", "sgd")
SCHEDULES = ("warmup-stable-decay", "exponential")
PRECISIONS = ("auto", "bfloat16", "float32")


@dataclass(frozen=True)
class TrainingSettings:
    """One run. Saved whole in the checkpoint, so that `--resume` needs nothing else."""

    network: NetworkSettings = field(default_factory=NetworkSettings)
    data: DataSettings = field(default_factory=DataSettings)
    loss: LossSettings = field(default_factory=LossSettings)
    steps: int = 40_000
    pool_steps: int = 10_000
    """Steps with one pool of clouds. From the second pool on the network filters some of them first: later passes see
    its own outputs."""
    optimizer: str = "adamw"
    """adamw (default) or sgd (the paper's, §3.4)."""
    learning_rate: float = 2e-3
    schedule: str = "warmup-stable-decay"
    """warmup-stable-decay (default): constant, then down to 0 in a line over the last `decay` of the run, so that a run
    that has not come so far can be made longer. exponential: from learning_rate down to final_learning_rate, as in the
    paper."""
    warmup: int = 1_000
    """Steps over which the learning rate rises."""
    decay: float = 0.25
    """Share of the run over which the learning rate falls."""
    final_learning_rate: float = 1e-8
    weight_decay: float = 1e-4
    gradient_clip: float = 1.0
    """Largest norm of the gradient; 0: no limit."""
    ema_decay: float = 0.999
    """The weights that are exported are an exponential moving average; 0 exports the last ones."""
    precision: str = "auto"
    """auto: bfloat16 products where the CPU multiplies them in hardware (AMX, AVX512-BF16), else float32."""
    threads: int = 0
    """0: one a core."""
    validate_every: int = 2_000
    validation_clouds: int = 4
    checkpoint_every: int = 500
    seed: int = 0

    def __post_init__(self) -> None:
        """A name that nobody knows must not pass for another one. Raises ValueError."""
        for name, found, known in (
            ("optimizer", [self.optimizer], OPTIMIZERS),
            ("schedule", [self.schedule], SCHEDULES),
            ("precision", [self.precision], PRECISIONS),
            ("loss.loss", [self.loss.loss], LOSSES),
        ):
            if not set(found) <= set(known):
                raise ValueError(f"{name} must be one of {', '.join(known)}, not {', '.join(found)}")
        if (self.loss.loss == "surface") != self.network.adaptive:
            raise ValueError("the loss 'surface' and network.adaptive need each other")
        for name, widths in (("encoder", self.network.encoder), ("decoder", self.network.decoder)):
            if not widths:
                raise ValueError(f"network.{name} must have at least one layer")
        if self.pool_steps < 1:
            raise ValueError(f"pool_steps must be at least 1, not {self.pool_steps}")
        if not 0 < self.decay <= 1:
            raise ValueError(f"decay must be above 0 and at most 1, not {self.decay}")
        if not self.network.adaptive and self.data.queries != 1:
            raise ValueError("data.queries must be 1 for a network that is not adaptive")

    @property
    def decay_from(self) -> int:
        """The step from which on the learning rate depends on the length of the run."""
        return 0 if self.schedule == "exponential" else round(self.steps * (1 - self.decay))

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> TrainingSettings:
        values = dict(values)
        data = dict(values["data"], noise_levels=tuple(values["data"]["noise_levels"]))
        values["network"] = NetworkSettings.from_dict(values["network"])
        values["data"] = DataSettings(**data)
        values["loss"] = LossSettings(**values["loss"])
        return cls(**values)
