from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from training.dataset import TrainingCloud
from training.pools import Pools
from training.settings import TrainingSettings


def same(a: list[TrainingCloud], b: list[TrainingCloud]) -> bool:
    return len(a) == len(b) and all(np.array_equal(x.points, y.points) for x, y in zip(a, b, strict=True))


def test_another_process_makes_the_clouds_that_this_one_would(tiny: TrainingSettings) -> None:
    with Pools(tiny.data, 2) as pools:
        first, second = pools(0), pools(1)
    assert same(first, Pools(tiny.data)(0))
    assert same(second, Pools(tiny.data)(1))
    assert not same(first, second)
    rows, radii = np.arange(9), np.full(9, second[0].index.edge)
    assert second[0].index.patches(rows, radii, 16, 0).counts.max() > 1


def test_pools_go_on_where_the_one_before_ended(tiny: TrainingSettings) -> None:
    whole = Pools(dataclasses.replace(tiny.data, clouds=4))(0)
    assert same(whole, [*Pools(tiny.data)(0), *Pools(tiny.data)(1)])


def test_stopped_between_clouds(tiny: TrainingSettings) -> None:
    with pytest.raises(KeyboardInterrupt):
        Pools(tiny.data, stop=lambda: True)(0)
