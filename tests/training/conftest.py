from __future__ import annotations

from collections.abc import Callable
from functools import cache

import pytest

from training.dataset import TrainingCloud
from training.pools import Pools
from training.presets import load_preset
from training.settings import TrainingSettings

MadePools = Callable[[int], list[TrainingCloud]]

TINY = [
    "network.encoder=[8, 16]",
    "network.decoder=[8]",
    "data.clouds=2",
    "data.fewest_points=1000",
    "data.most_points=2000",
    "data.clean_points=2000",
    "data.patch_points=32",
    "data.clean_patch_points=48",
    "data.batch=16",
    "data.clouds_per_batch=4",
    "data.largest_ball=200",
    "data.queries=4",
    "data.own_points=300",
    "pool_steps=6",
    "warmup=2",
    "steps=12",
    "threads=1",
    'precision="float32"',
    "validation_clouds=0",
    "validate_every=4",
    "checkpoint_every=4",
]


@pytest.fixture(scope="session")
def tiny() -> TrainingSettings:
    return load_preset("smoke", TINY)


@pytest.fixture(scope="session")
def tiny_paper() -> TrainingSettings:
    """The same for the paper's network and loss."""
    return load_preset(
        "smoke", [*TINY, "network.adaptive=false", "network.mean_pool=false", 'loss.loss="bilateral"', "data.queries=1"]
    )


@pytest.fixture(scope="session")
def pools(tiny: TrainingSettings) -> MadePools:
    return cache(Pools(tiny.data))


@pytest.fixture(scope="session")
def clouds(pools: MadePools) -> list[TrainingCloud]:
    return pools(0)
