"""Training clouds and the batches cut from them.

A batch is a pure function of (settings, clouds, step): nothing has a state to save, so a run that was killed resumes
exactly. Patches come from pointfilter.patches, as they do in the service.
"""

from __future__ import annotations

import queue
import re
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from pointfilter.noise import bounding_box_diagonal
from pointfilter.patches import NeighbourIndex
from training.losses import surface_distances
from training.network import context
from training.scanning import scan
from training.shapes import Mesh, random_shape

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]

VALIDATION_POINTS = 15_000  # enough to see a trend, few enough to filter in seconds
VALIDATION_FAMILY = 1  # of shapes; training has family 0
VALIDATION_SEED = 2**40  # of points and noise: no training cloud's
TYPICAL_BALL = 100  # points; the grid's edge is the radius of a ball of so many, in the median
FALLBACK_BALL = 24  # points, where the ball that was drawn is larger than the cloud


@dataclass(frozen=True)
class DataSettings:
    """What the network is shown: one pool of clouds after another."""

    clouds: int = 240
    """Clouds of a pool; every one has a shape, a density and a noise level of its own."""
    fewest_points: int = 2_000
    most_points: int = 200_000
    """Densities are drawn evenly on a logarithmic scale between the two."""
    clean_points: int = 150_000
    """Points of the clean cloud to which distances are taken."""
    noise_low: float = 0.0003
    noise_high: float = 0.06
    """Noise levels, as fractions of the bounding-box diagonal, drawn evenly on a logarithmic scale between the two."""
    clean_share: float = 0.1
    """Share of the clouds that have no noise at all."""
    noise_levels: tuple[float, ...] = ()
    """These levels in turn instead, as in the paper."""
    plain_share: float = 0.5
    """Share of the clouds that are sampled evenly and have Gaussian noise; the others are scans (scanning.py)."""
    radius: float = 0.0
    """Patch radius as a fraction of the bounding-box diagonal (§3.2); 0: balls that hold a number of points."""
    smallest_ball: int = 20
    largest_ball: int = 4_000
    """Points in a ball, the number drawn evenly on a logarithmic scale between the two."""
    queries: int = 8
    """Points of a patch that the network answers for, the centre first."""
    query_reach: float = 0.45
    """Distance of the farthest query from the centre, in units of the radius."""
    own_share: float = 0.35
    """Share of the patches that come from clouds which the network itself has filtered, once the run has made them."""
    own_every: int = 5
    """A fifth of the clouds are filtered."""
    own_points: int = 8_000
    """Most points of such a cloud: a piece of a whole one, since filtering costs more than anything else here."""
    patch_points: int = 384
    """Most points of a noisy patch."""
    fewest_patch_points: int = 96
    """A larger ball is thinned to a number of points drawn evenly between the two: a patch of 96 costs a quarter of one
    of 384, and the network learns how the number of points changes what it sees."""
    clean_patch_points: int = 400
    """Clean points in the ball that the losses of the paper see."""
    batch: int = 64
    clouds_per_batch: int = 16
    """A batch's patches come from this many clouds."""
    seed: int = 0


@dataclass(frozen=True, eq=False)
class TrainingCloud:
    """A noisy cloud (n, 3) ready to cut patches from, with the clean one beside it. Lengths as in the shape, whose
    diagonal is 1.

    radius: of all patches, 0 where balls hold a number of points. later: whether the points have been through a pass.
    """

    points: Float64
    index: NeighbourIndex
    clean: CleanCloud
    radius: float
    later: bool = False


@dataclass(frozen=True, eq=False)
class Batch:
    """B patches and M queries. patches: (B, N, 3) float32. counts: (B,) int64, points that are not padding. context:
    (B, 2), see network.context. queries: (M, 3) float32, in the frames of their patches. owners: (M,) int64, their
    patches. still: (M,), distance of a query to the surface.

    clouds: (B,), the number of the cloud of each patch. centres: (B, 3), frames: (B, 3, 3) and radii: (B,), float64.
    """

    patches: Tensor
    counts: Tensor
    context: Tensor
    queries: Tensor
    owners: Tensor
    still: Tensor
    clouds: Int64
    centres: Float64
    frames: Float64
    radii: Float64


@dataclass(frozen=True, eq=False)
class CleanCloud:
    """(m, 3) points of a surface and their unit normals, with a tree over the points and their spacing."""

    points: Float64
    normals: Float64
    tree: cKDTree
    spacing: float


def make_clean(points: Float64, normals: Float64) -> CleanCloud:
    tree = cKDTree(points)
    distances, _ = tree.query(points[:: max(1, len(points) // 1000)], k=2)
    return CleanCloud(points, normals, tree, spacing=2 * float(np.median(distances[:, 1])))


def make_cloud(noisy: Float64, clean: CleanCloud, radius: float = 0.0, later: bool = False) -> TrainingCloud:
    """Indexes the distinct places of a noisy cloud, as the filter does; `radius` is absolute."""
    _, first = np.unique(noisy, axis=0, return_index=True)
    noisy = noisy[np.sort(first)]
    edge = radius
    if not edge:
        ball, _ = cKDTree(noisy).query(noisy[:: max(1, len(noisy) // 500)], k=[min(TYPICAL_BALL, len(noisy))])
        edge = float(np.median(ball))
    return TrainingCloud(noisy, NeighbourIndex(noisy, max(edge, 1e-6)), clean, radius, later)


def cloud_from_mesh(mesh: Mesh, settings: DataSettings, seed: int) -> TrainingCloud:
    """One training cloud: density, noise and the way of scanning all drawn from the seed."""
    rng = np.random.default_rng([seed, settings.seed, 0xC10D])
    count = round(np.exp(rng.uniform(np.log(settings.fewest_points), np.log(settings.most_points))))
    level = 0.0
    if settings.noise_levels:
        level = settings.noise_levels[seed % len(settings.noise_levels)]
    elif rng.random() >= settings.clean_share:
        level = float(np.exp(rng.uniform(np.log(settings.noise_low), np.log(settings.noise_high))))
    clean, normals = mesh.sample(settings.clean_points, rng)
    noisy = scan(mesh, count, level, rng, settings.plain_share)
    return make_cloud(noisy, make_clean(clean, normals), settings.radius * bounding_box_diagonal(clean))


def load_author_clouds(folder: Path, radius: float) -> list[TrainingCloud]:
    """Clouds in the layout of the authors' code: NAME.npy, NAME_normal.npy and one NAME_LEVEL.npy a noise level.

    Raises FileNotFoundError when the folder holds none, ValueError when shapes disagree or values are not finite.
    """
    clouds = []
    for normal_path in sorted(folder.glob("*_normal.npy")):
        name = normal_path.name.removesuffix("_normal.npy")
        clean = np.load(folder / f"{name}.npy", allow_pickle=False).astype(np.float64)
        normals = np.load(normal_path, allow_pickle=False).astype(np.float64)
        if clean.ndim != 2 or clean.shape[1] != 3 or normals.shape != clean.shape:
            raise ValueError(f"{normal_path} {normals.shape} and {name}.npy {clean.shape} must both be (n, 3)")
        if not (np.isfinite(clean).all() and np.isfinite(normals).all()):
            raise ValueError(f"{normal_path} and {name}.npy must hold finite values only")
        diagonal, surface = bounding_box_diagonal(clean), make_clean(clean, normals)
        pattern = re.compile(re.escape(name) + r"_\d+(\.\d+)?\.npy")
        noisy_paths = [  # cube_2.npy is another model where cube_2_normal.npy is there too
            path
            for path in sorted(folder.iterdir())
            if pattern.fullmatch(path.name) and not (folder / f"{path.stem}_normal.npy").exists()
        ]
        for path in [folder / f"{name}.npy", *noisy_paths]:  # the clean cloud is one without noise
            noisy = np.load(path, allow_pickle=False).astype(np.float64)
            if noisy.ndim != 2 or noisy.shape[1] != 3 or not np.isfinite(noisy).all():
                raise ValueError(f"{path} {noisy.shape} must be (n, 3), all of its values finite")
            clouds.append(make_cloud(noisy, surface, radius * diagonal))
    if not clouds:
        raise FileNotFoundError(f"no NAME.npy with NAME_normal.npy in {folder}")
    return clouds


def validation_cloud(number: int, settings: DataSettings) -> TrainingCloud:
    """A cloud of a shape that no run trains on, the same for all runs with the settings' radius and clean points."""
    same = DataSettings(
        fewest_points=VALIDATION_POINTS,
        most_points=VALIDATION_POINTS,
        clean_points=settings.clean_points,
        radius=settings.radius,
        noise_levels=(0.0025, 0.005, 0.01, 0.02),
        plain_share=1.0,
    )
    return cloud_from_mesh(random_shape(number, VALIDATION_FAMILY), same, VALIDATION_SEED + number)


def cut_batch(clouds: Sequence[TrainingCloud], settings: DataSettings, step: int) -> Batch:
    """Batch number `step`: the same arguments always give the same batch. Clouds that have been through a pass make up
    settings.own_share of it, once there are any."""
    rng = np.random.default_rng([settings.seed, step])
    each = -(-settings.batch // settings.clouds_per_batch)
    first = [number for number, cloud in enumerate(clouds) if not cloud.later]
    later = [number for number, cloud in enumerate(clouds) if cloud.later]
    numbers, centres, patches, frames, counts, lengths, radii = [], [], [], [], [], [], []
    fewest = min(settings.fewest_patch_points, settings.patch_points)
    for _ in range(settings.clouds_per_batch):
        group = later if later and rng.random() < settings.own_share else first
        number = group[int(rng.integers(len(group)))]
        cloud = clouds[number]
        rows = rng.integers(len(cloud.points), size=each)
        key = int(rng.integers(2**63))
        length = int(rng.integers(fewest, settings.patch_points + 1))
        patch = cloud.index.patches(rows, _radii(cloud, rows, settings, rng), length, key)
        numbers.append(np.full(each, number))
        centres.append(cloud.points[rows])
        patches.append(np.pad(patch.points, ((0, 0), (0, settings.patch_points - length), (0, 0))))
        frames.append(patch.frames)
        counts.append(patch.counts)
        lengths.append(np.minimum(patch.counts, length))
        radii.append(patch.radii)

    def joined(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate(parts)[: settings.batch]

    numbers_of, points = joined(numbers), joined(patches)
    queries, owners = _queries(points, joined(lengths), settings, rng)
    batch = Batch(
        patches=torch.from_numpy(points),
        counts=torch.from_numpy(joined(lengths)),
        context=context(
            torch.from_numpy(np.maximum(joined(counts), 1)),
            torch.tensor([clouds[number].later for number in numbers_of]),
        ),
        queries=torch.from_numpy(queries),
        owners=torch.from_numpy(owners),
        still=torch.zeros(len(queries)),
        clouds=numbers_of,
        centres=joined(centres),
        frames=joined(frames),
        radii=joined(radii),
    )
    nearest, normals, spacing = nearest_on_surface(batch, clouds, batch.queries)
    batch.still.copy_(surface_distances(batch.queries - nearest, normals, spacing)[0])
    return batch


def _radii(cloud: TrainingCloud, rows: Int64, settings: DataSettings, rng: np.random.Generator) -> Float64:
    if cloud.radius:
        return np.full(len(rows), cloud.radius)
    low, high = np.log(settings.smallest_ball), np.log(min(settings.largest_ball, len(cloud.points) - 1))
    sizes = np.exp(rng.uniform(low, max(low, high), len(rows))).astype(np.int64)
    both = np.stack([sizes, np.minimum(sizes, FALLBACK_BALL)], axis=1)
    guesses = cloud.index.edge * np.sqrt(sizes / TYPICAL_BALL)
    radii, fallback = cloud.index.ball_radii(rows, both, guesses).T
    radii = np.where(np.isfinite(radii), radii, np.where(np.isfinite(fallback), fallback, 8 * cloud.index.edge))
    return np.maximum(radii, 1e-9)


def _queries(
    patches: Float32, counts: Int64, settings: DataSettings, rng: np.random.Generator
) -> tuple[Float32, Int64]:
    """The centre of each patch and random points of it near the centre: (M, 3) float32, and their patches (M,)."""
    batch, length, _ = patches.shape
    near = np.square(patches).sum(axis=2) < settings.query_reach**2
    near &= np.arange(length) < counts[:, None]
    order = np.argsort(np.where(near, rng.random((batch, length)), 2.0), axis=1)[:, : settings.queries - 1]
    rows = np.arange(batch)[:, None]
    chosen = near[rows, order]
    queries = np.concatenate([np.zeros((batch, 3), np.float32), patches[rows, order][chosen]])
    owners = np.concatenate([np.arange(batch), np.broadcast_to(rows, order.shape)[chosen]])
    return queries, owners


def nearest_on_surface(batch: Batch, clouds: Sequence[TrainingCloud], points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """For one point (M, 3) a query, in the frame of its patch: the nearest clean point of the whole cloud, its normal,
    both (M, 3) and in that frame, and the spacing (M,) of the clean points, in units of the radius."""
    owners = batch.owners.numpy()
    frames, radii, centres = batch.frames[owners], batch.radii[owners], batch.centres[owners]
    places = np.einsum("mi,mij->mj", points.detach().numpy().astype(np.float64), frames) * radii[:, None] + centres
    offsets, normals, spacing = np.empty_like(places), np.empty_like(places), np.empty(len(places))
    numbers = batch.clouds[owners]
    for number in np.unique(numbers):
        rows = np.flatnonzero(numbers == number)
        clean = clouds[number].clean
        _, found = clean.tree.query(places[rows])
        offsets[rows] = clean.points[found] - centres[rows]
        normals[rows] = clean.normals[found]
        spacing[rows] = clean.spacing / radii[rows]
    turned = np.einsum("mij,mj->mi", frames, offsets) / radii[:, None], np.einsum("mij,mj->mi", frames, normals)
    nearest, true_normals = (torch.from_numpy(values.astype(np.float32)) for values in turned)
    return nearest, true_normals, torch.from_numpy(spacing.astype(np.float32))


def clean_patches(
    batch: Batch, clouds: Sequence[TrainingCloud], settings: DataSettings, step: int
) -> tuple[Tensor, Tensor, Tensor]:
    """What the losses of the paper see: clean points in the balls, their normals, both (B, M, 3) float32 in the frames
    of the patches, and which rows are not padding, (B, M) bool."""
    rng = np.random.default_rng([settings.seed, step, 0xC1EA])
    most = settings.clean_patch_points
    offsets, normals = np.zeros((2, len(batch.centres), most, 3))
    present = np.zeros((len(batch.centres), most), dtype=bool)
    for row, number in enumerate(batch.clouds):
        clean = clouds[number].clean
        found = np.asarray(clean.tree.query_ball_point(batch.centres[row], batch.radii[row]), dtype=np.int64)
        found = found if len(found) <= most else rng.choice(found, most, replace=False)
        frame = batch.frames[row]
        offsets[row, : len(found)] = (clean.points[found] - batch.centres[row]) @ frame.T / batch.radii[row]
        normals[row, : len(found)] = clean.normals[found] @ frame.T
        present[row, : len(found)] = True
    near, turned = (torch.from_numpy(values.astype(np.float32)) for values in (offsets, normals))
    return near, turned, torch.from_numpy(present)


def batches_ahead(
    clouds: Sequence[TrainingCloud], settings: DataSettings, first_step: int, last_step: int, ahead: int = 4
) -> Iterator[Batch]:
    """Batches first_step .. last_step - 1 in order, cut by a second thread while the network trains."""
    ready: queue.Queue[Batch | Exception] = queue.Queue(maxsize=ahead)
    closed = threading.Event()

    def put(item: Batch | Exception) -> None:
        while not closed.is_set():
            try:
                ready.put(item, timeout=0.2)
            except queue.Full:
                continue
            return

    def work() -> None:
        try:
            for step in range(first_step, last_step):
                if closed.is_set():
                    return
                put(cut_batch(clouds, settings, step))
        except Exception as error:  # noqa: BLE001 - handed to the consumer, who raises it
            put(error)

    thread = threading.Thread(target=work, name="batches", daemon=True)
    thread.start()
    try:
        for _ in range(first_step, last_step):
            item = ready.get()
            if isinstance(item, Exception):
                raise item
            yield item
    finally:
        closed.set()
        thread.join()
