"""Training clouds that the network itself has filtered: what later passes see."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pointfilter.adaptive.calibration import Calibration
from pointfilter.filter import filter_points
from pointfilter.network import Answers, Network
from training.dataset import DataSettings, TrainingCloud, make_cloud
from training.network import Pointfilter

UNCALIBRATED = Calibration(
    balls=(24, 48, 96, 192, 384, 768, 1536, 3072),
    preference=0.05,
    still_weight=1.0,
    margin=0.0,
    passes=4,
    query_reach=0.45,
    error_factor=1.0,
)
"""How the filter uses a network of which nothing has been measured yet."""
MOST_PASSES = 3  # that such a cloud has been through


def own_clouds(
    file: Path, clouds: Sequence[TrainingCloud], network: Pointfilter, settings: DataSettings
) -> list[TrainingCloud]:
    """A piece of every settings.own_every-th cloud after one to MOST_PASSES passes of the network.

    The pieces are kept in `file` and come from there when it exists, so that a resumed run sees the same.
    """
    chosen = range(0, len(clouds), settings.own_every)
    if not file.exists():
        pieces = {str(number): _filtered_piece(number, clouds[number], network, settings) for number in chosen}
        partial = file.with_suffix(".partial.npz")
        np.savez(partial, allow_pickle=False, **pieces)
        partial.replace(file)
    with np.load(file, allow_pickle=False) as saved:
        return [
            make_cloud(saved[str(number)], clouds[number].clean, clouds[number].radius, later=True) for number in chosen
        ]


def _filtered_piece(
    number: int, cloud: TrainingCloud, network: Pointfilter, settings: DataSettings
) -> NDArray[np.float64]:
    rng = np.random.default_rng([settings.seed, number, 0x0E1])
    piece = rows_of_piece(cloud.points, settings.own_points, rng)
    return filter_points(
        cloud.points[np.sort(piece)],
        as_network(network),
        calibration=UNCALIBRATED,
        iterations=int(rng.integers(1, MOST_PASSES + 1)),
        patch_points=settings.patch_points,
        seed=number,
    ).points


def rows_of_piece(points: NDArray[np.float64], most: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """The rows of a random one of (n, 3) points and of the points nearest to it, `most` in all, nearest first."""
    middle = points[rng.integers(len(points))]
    rows: NDArray[np.int64] = cKDTree(points).query(middle, k=min(most, len(points)))[1]
    return rows


def as_network(network: Pointfilter) -> Network:
    """A torch network in evaluation mode as the callable that the filter expects."""

    def ask(
        patches: NDArray[np.float32],
        context: NDArray[np.float32],
        queries: NDArray[np.float32],
        owners: NDArray[np.int64],
    ) -> Answers:
        with torch.inference_mode():
            if not network.settings.adaptive:
                return Answers(network(torch.from_numpy(patches)).numpy())
            said = network.answer(*(torch.from_numpy(values) for values in (patches, queries, owners, context)))
            errors = torch.stack([said.log_moved, said.log_still], dim=1)
            return Answers(said.displacements.numpy(), errors.numpy(), said.normals.numpy())

    return ask
