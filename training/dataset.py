"""Training clouds and the batches cut from them.

A batch is a pure function of (settings, step): nothing has a state to save, so a run that was killed resumes exactly.
Patches come from pointfilter.patches, as they do in the service.
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

from pointfilter.automatic import with_fitting_ball
from pointfilter.engine import Engine
from pointfilter.filtering import filter_points
from pointfilter.models import DEFAULT_MODEL, open_model
from pointfilter.noise import NoiseKind, add_noise, bounding_box_diagonal
from pointfilter.patches import NeighbourIndex, stable_ids
from training.shapes import Mesh, load_meshes, random_shape

Float64 = NDArray[np.float64]

FILTERED_ITERATIONS = 3  # most passes that a cloud of DataSettings.filtered_share went through
VALIDATION_POINTS = 15_000  # enough to see a trend, few enough to filter in seconds
VALIDATION_FAMILY = 1  # of shapes; training has family 0
VALIDATION_SEED = 2**40  # of points and noise: no training cloud's


@dataclass(frozen=True)
class DataSettings:
    """What the network is shown."""

    clouds: int = 240
    """Training clouds; every one has a shape, a density and a noise level of its own."""
    thin_share: float = 0.0
    """Share of the procedural shapes that are thin: sheets, tubes, slots, wires, with two surfaces within a patch."""
    fewest_points: int = 10_000
    most_points: int = 300_000
    """Densities are drawn evenly on a logarithmic scale between the two."""
    clean_points: int = 100_000
    """Points of the clean cloud that the loss sees (at least as many as the noisy cloud has)."""
    noise_low: float = 0.0
    noise_high: float = 0.025
    """Noise levels, as fractions of the bounding-box diagonal."""
    noise_skew: float = 1.5
    """Levels are low + (high - low)·u^skew for an even u: above 1, low noise is seen more often."""
    noise_kinds: tuple[NoiseKind, ...] = ("gaussian",)
    open_share: float = 0.25
    """Share of the clouds that are cut open by a plane, as a scan is."""
    uneven_share: float = 0.25
    """Share of the clouds whose density changes from one side to the other."""
    radius: float = 0.05
    """Patch radius as a fraction of the bounding-box diagonal (§3.2)."""
    radius_grows: bool = False
    """Clouds get the radius that the filter would take (docs/adr/0014, 0017), with filtered_by."""
    filtered_share: float = 0.0
    """Share of the clouds that went through filtered_by before: what later iterations see."""
    filtered_by: str = DEFAULT_MODEL
    """A bundle's name or folder."""
    filtered_points: int = 15_000
    """Most points of such a cloud: a piece of the whole one, since filtering costs more than anything else here."""
    patch_points: int = 256
    """Points of a noisy patch."""
    clean_patch_points: int = 400
    """Points of a clean patch that the loss sees."""
    batch: int = 64
    clouds_per_batch: int = 16
    """A batch's patches come from this many clouds."""
    seed: int = 0


@dataclass(frozen=True)
class TrainingCloud:
    """A noisy cloud ready to cut patches from, with the clean one beside it. Lengths as in the shape: diagonal 1."""

    points: Float64
    ids: NDArray[np.uint64]
    index: NeighbourIndex
    clean: Float64
    normals: NDArray[np.float32]
    clean_ids: NDArray[np.uint64]
    clean_index: NeighbourIndex


@dataclass(frozen=True)
class Batch:
    """patches (B, N, 3), clean (B, M, 3), normals (B, M, 3) float32, present (B, M) bool; see losses.filtering_loss."""

    patches: Tensor
    clean: Tensor
    normals: Tensor
    present: Tensor


def make_cloud(noisy: Float64, clean: Float64, normals: Float64, radius: float) -> TrainingCloud:
    """Indexes a noisy and a clean cloud; `radius` is absolute."""
    ids, clean_ids = stable_ids(noisy), stable_ids(clean)
    return TrainingCloud(
        points=noisy,
        ids=ids,
        index=NeighbourIndex(noisy, radius, ids),
        clean=clean,
        normals=normals.astype(np.float32),
        clean_ids=clean_ids,
        clean_index=NeighbourIndex(clean, radius, clean_ids),
    )


def cloud_from_mesh(mesh: Mesh, settings: DataSettings, seed: int, engine: Engine | None = None) -> TrainingCloud:
    """One training cloud: density, noise, openness and evenness all drawn from the seed.

    engine: what filters a share of the clouds before and says how large a radius has to be, see DataSettings.
    """
    rng = np.random.default_rng([seed, settings.seed, 0xC10D])
    count = round(np.exp(rng.uniform(np.log(settings.fewest_points), np.log(settings.most_points))))
    level = settings.noise_low + (settings.noise_high - settings.noise_low) * rng.random() ** settings.noise_skew
    points, normals = mesh.sample(max(count, settings.clean_points), rng)
    noisy, _ = mesh.sample(2 * count, rng)
    if rng.random() < settings.uneven_share:
        slope = noisy @ rng.normal(size=3)
        share = 0.1 + 0.9 * (slope - slope.min()) / np.ptp(slope)
        noisy = noisy[rng.random(len(noisy)) < share]
    noisy = noisy[:count]
    kind = settings.noise_kinds[int(rng.integers(len(settings.noise_kinds)))]
    diagonal = bounding_box_diagonal(points)
    noisy = add_noise(noisy, level, rng, kind, diagonal)
    if rng.random() < settings.open_share:
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        border = np.quantile(points @ direction, rng.uniform(0.5, 0.9))
        noisy = noisy[noisy @ direction < border]
        keep = points @ direction < border
        points, normals = points[keep], normals[keep]
    radius = settings.radius * diagonal
    if engine is not None and settings.radius_grows:
        ids = stable_ids(noisy)
        index, _ = with_fitting_ball(
            NeighbourIndex(noisy, radius, ids), noisy, ids, engine, engine.bundle.patch_points, seed
        )
        radius = index.radius
    if engine is not None and rng.random() < settings.filtered_share:
        middle = noisy[rng.integers(len(noisy))]
        _, piece = cKDTree(noisy).query(middle, k=min(settings.filtered_points, len(noisy)))
        noisy = filter_points(
            noisy[np.sort(piece)],
            engine,
            radius=radius,
            iterations=int(rng.integers(1, FILTERED_ITERATIONS + 1)),
            patch_points=engine.bundle.patch_points,
            seed=seed,
        )
    return make_cloud(noisy, points, normals, radius)


def load_author_clouds(folder: Path, radius: float) -> list[TrainingCloud]:
    """Clouds in the layout of the authors' code: NAME.npy, NAME_normal.npy and one NAME_LEVEL.npy a noise level.

    Raises FileNotFoundError when the folder holds none, ValueError when shapes disagree.
    """
    clouds = []
    for normal_path in sorted(folder.glob("*_normal.npy")):
        name = normal_path.name.removesuffix("_normal.npy")
        clean = np.load(folder / f"{name}.npy", allow_pickle=False).astype(np.float64)
        normals = np.load(normal_path, allow_pickle=False).astype(np.float64)
        if clean.ndim != 2 or clean.shape[1] != 3 or normals.shape != clean.shape:
            raise ValueError(f"{normal_path} {normals.shape} and {name}.npy {clean.shape} must both be (n, 3)")
        diagonal = bounding_box_diagonal(clean)
        pattern = re.compile(re.escape(name) + r"_\d+(\.\d+)?\.npy")
        noisy_paths = [  # cube_2.npy is another model where cube_2_normal.npy is there too
            path
            for path in sorted(folder.iterdir())
            if pattern.fullmatch(path.name) and not (folder / f"{path.stem}_normal.npy").exists()
        ]
        for path in noisy_paths or [folder / f"{name}.npy"]:
            noisy = np.load(path, allow_pickle=False).astype(np.float64)
            clouds.append(make_cloud(noisy, clean, normals, radius * diagonal))
    if not clouds:
        raise FileNotFoundError(f"no NAME.npy with NAME_normal.npy in {folder}")
    return clouds


def _filter_of(settings: DataSettings) -> Engine | None:
    """What DataSettings.filtered_by names, where the settings need it."""
    needed = settings.filtered_share > 0 or settings.radius_grows
    return Engine(open_model(settings.filtered_by), threads=1) if needed else None


def training_clouds(
    settings: DataSettings, meshes: Path | None = None, clouds: Path | None = None
) -> Iterator[TrainingCloud]:
    """The clouds of a run: from the authors' layout, from the user's meshes, or procedural (the default)."""
    if clouds is not None:
        yield from load_author_clouds(clouds, settings.radius)
        return
    loaded = load_meshes(meshes) if meshes is not None else None
    engine = _filter_of(settings)
    for number in range(settings.clouds):
        seed = settings.seed * 10_000 + number
        mesh = loaded[number % len(loaded)] if loaded else random_shape(seed, thin_share=settings.thin_share)
        yield cloud_from_mesh(mesh, settings, seed, engine)


def validation_cloud(number: int, settings: DataSettings) -> TrainingCloud:
    """A cloud of a shape that no run trains on, the same for all runs with the settings' radius and clean points."""
    same = DataSettings(
        fewest_points=VALIDATION_POINTS,
        most_points=VALIDATION_POINTS,
        clean_points=settings.clean_points,
        radius=settings.radius,
        radius_grows=settings.radius_grows,
        filtered_by=settings.filtered_by,
        open_share=0.0,
        uneven_share=0.0,
    )
    return cloud_from_mesh(random_shape(number, VALIDATION_FAMILY), same, VALIDATION_SEED + number, _filter_of(same))


def cut_batch(clouds: list[TrainingCloud], settings: DataSettings, step: int) -> Batch:
    """Batch number `step`: the same arguments always give the same batch."""
    rng = np.random.default_rng([settings.seed, step])
    each = -(-settings.batch // settings.clouds_per_batch)
    patches, frames, centres, near, clean, normals = [], [], [], [], [], []
    for number in rng.integers(len(clouds), size=settings.clouds_per_batch):
        cloud = clouds[number]
        rows = rng.integers(len(cloud.points), size=each)
        key = int(rng.integers(2**63))
        patch = cloud.index.patches(cloud.points[rows], cloud.ids[rows], settings.patch_points, key)
        found, _ = cloud.clean_index.sample(cloud.points[rows], cloud.ids[rows], settings.clean_patch_points, key)
        patches.append(patch.points)
        frames.append(patch.frames / cloud.index.radius)
        centres.append(cloud.points[rows])
        near.append(found)
        clean.append(cloud.clean[found])
        normals.append(cloud.normals[found])

    def joined(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate(parts)[: settings.batch]

    present = joined(near) >= 0
    turn = joined(frames).transpose(0, 2, 1)
    offsets = (joined(clean) - joined(centres)[:, None, :]).astype(np.float32) @ turn.astype(np.float32)
    turned = joined(normals) @ (turn / np.linalg.norm(turn, axis=1, keepdims=True)).astype(np.float32)
    return Batch(
        torch.from_numpy(joined(patches)),
        torch.from_numpy(np.where(present[:, :, None], offsets, np.float32(0))),
        torch.from_numpy(np.where(present[:, :, None], turned, np.float32(0))),
        torch.from_numpy(present),
    )


def batches_ahead(
    clouds: list[TrainingCloud], settings: DataSettings, first_step: int, last_step: int, ahead: int = 4
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
