"""Simulated scans of a mesh: density, self-occlusion, noise of several kinds and the other defects of real clouds.

Each effect is one function; `scan` decides at random which of them a cloud has. Lengths are those of the mesh, whose
bounding-box diagonal is 1.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree

from training.shapes import Mesh

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]
Rng = np.random.Generator
Noise = Callable[[Float64, float | Float64, Rng], Float64]  # points, deviation, rng -> moved points

PLAIN_SHARE = 0.5
"""Share of the clouds that are sampled evenly and have Gaussian noise and nothing else."""
OCCLUSION_POINTS = 20_000
"""Points whose visibility is computed exactly; the others take it from the nearest of them."""
MAX_BATCHES = 6
"""Batches of samples drawn at most to find enough visible points."""
IMPULSE_SHARE = 0.1
MAX_OUTLIER_SHARE = 0.02
MAX_DUPLICATE_SHARE = 0.1


def scan(mesh: Mesh, count: int, level: float, rng: Rng, plain_share: float = PLAIN_SHARE) -> Float64:
    """A noisy point cloud of the mesh: (m, 3) float64, finite, with count / 3 <= m <= 1.2 · count.

    level: standard deviation of the noise per coordinate, as a fraction of the diagonal. plain_share: probability of a
    cloud with even sampling and Gaussian noise only. Raises ValueError for a count below 10 or a negative level.
    """
    if count < 10 or not level >= 0:
        raise ValueError(f"count must be at least 10 and level at least 0, got {count} and {level}")
    if rng.random() < plain_share:
        return gaussian(mesh.sample(count, rng)[0], level, rng)

    points, views, view = _sampled(mesh, count, rng)
    if rng.random() < 0.3:
        kept = cut_open(points, rng)
        points, view = points[kept], view[kept]
    rays = points - views[view]
    rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)

    deviation: float | Float64 = level
    if rng.random() < 0.25:
        deviation = level * smooth_factor(points, rng)
    kind = rng.random()
    if kind < 0.4:
        noisy = gaussian(points, deviation, rng)
    elif kind < 0.6:
        noisy = along_rays(points, deviation, rng, rays)
    else:
        noisy = _NOISES[int(rng.integers(len(_NOISES)))](points, deviation, rng)
    if len(views) > 1 and rng.random() < 0.3:
        noisy = misregistered(noisy, view, level, rng)
    if rng.random() < 0.15:
        noisy = with_outliers(noisy, rng)
    if level > 0 and rng.random() < 0.2:
        noisy = quantised(noisy, level * rng.uniform(0.1, 1.0), rng)
    if rng.random() < 0.1:
        noisy = with_duplicates(noisy, rng)
    return noisy


def _sampled(mesh: Mesh, count: int, rng: Rng) -> tuple[Float64, Float64, NDArray[np.int64]]:
    """At most `count` points with a random density, the (k, 3) view points, and which of them saw each point.

    Even sampling has one view point as well, only to have rays for the noise along them.
    """
    pick = rng.random()
    if pick < 0.55:
        views = view_points(int(rng.choice([1, 1, 2, 3, 4])), rng)
        points, view = seen_from(mesh, count, views, rng)
        if len(points) >= count / 1.5:  # cut_open may halve them
            return points, views, view
    views = view_points(1, rng)
    points, _ = mesh.sample(4 * count if pick < 0.85 else count, rng)
    if pick < 0.85:
        share = falling_density(points, rng) if pick < 0.7 else distance_density(points, views[0], rng)
        points = points[rng.random(len(points)) < share][:count]
        if len(points) < count / 1.5:  # a view point close to a small part of the mesh
            points, _ = mesh.sample(count, rng)
    return points, views, np.zeros(len(points), np.int64)


# --- Density ------------------------------------------------------------------------------------------------------


def falling_density(points: Float64, rng: Rng) -> Float64:
    """Probability of keeping each point: falls along a random direction to between 2 % and 50 %."""
    along = points @ rng.normal(size=3)
    sparse = rng.uniform(0.02, 0.5)
    share: Float64 = sparse + (1 - sparse) * (along - along.min()) / max(float(np.ptp(along)), 1e-12)
    return share


def distance_density(points: Float64, view_point: Float64, rng: Rng) -> Float64:
    """Probability of keeping each point: falls with the distance from the view point, as 1 / d to 1 / d²."""
    distances = np.linalg.norm(points - view_point, axis=1)
    near = max(float(np.quantile(distances, 0.2)), 1e-12)
    share: Float64 = np.minimum(near / np.maximum(distances, 1e-12), 1.0) ** rng.uniform(1, 2)
    return share


# --- View points and self-occlusion -------------------------------------------------------------------------------


def view_points(count: int, rng: Rng) -> Float64:
    """(count, 3) places: most of the time 0.6 to 4 diagonals from the middle and above it, else near the middle.

    The latter stand inside rooms and between objects.
    """
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    if rng.random() < 0.6:
        directions[:, 2] = np.abs(directions[:, 2])
    near, far = (0.05, 0.4) if rng.random() < 0.2 else (0.6, 4.0)
    views: Float64 = directions * np.exp(rng.uniform(np.log(near), np.log(far), (count, 1)))
    return views


def visible(points: Float64, view_point: Float64, radius_exponent: float = 3.0) -> Bool:
    """Hidden point removal (Katz, Tal and Basri 2007): which of (n, 3) points can be seen from the view point.

    Points are flipped about a sphere of radius 10^radius_exponent times the largest distance; those on the convex hull
    of the flipped points and the view point are visible. A larger exponent calls more points visible.
    """
    offsets = points - view_point
    distances = np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-12)
    radius = distances.max() * 10**radius_exponent
    flipped = offsets + 2 * (radius - distances) * offsets / distances
    try:
        hull = ConvexHull(np.vstack([flipped, np.zeros(3)]))
    except QhullError:  # a flat mesh seen from its own plane
        return np.ones(len(points), np.bool_)
    mask = np.zeros(len(points) + 1, np.bool_)
    mask[hull.vertices] = True
    return mask[:-1]


def seen_from(mesh: Mesh, count: int, views: Float64, rng: Rng) -> tuple[Float64, NDArray[np.int64]]:
    """At most `count` points that are visible from a view point, denser where the surface faces it, and its number.

    Every view point sees about the same number of points; fewer than `count` come back where little is visible.
    """
    # The normal tells the two sides of a thin sheet apart when visibility is taken from the nearest point.
    weight = 0.1
    sparse, normals = mesh.sample(OCCLUSION_POINTS, rng)
    tree = cKDTree(np.hstack([sparse, weight * normals]))
    masks = [visible(sparse, view_point, rng.uniform(2.5, 3.5)) for view_point in views]
    by_angle = rng.random() < 0.7
    power = rng.uniform(0.5, 2.0)
    wanted = -(-count // len(views))
    found: list[list[Float64]] = [[] for _ in views]
    for _ in range(MAX_BATCHES):
        points, normals = mesh.sample(2 * count, rng)
        nearest = tree.query(np.hstack([points, weight * normals]))[1]
        for number, (view_point, mask) in enumerate(zip(views, masks, strict=True)):
            share = mask[nearest].astype(np.float64)
            if by_angle:
                rays = points - view_point
                squares = np.maximum(np.einsum("nd,nd->n", rays, rays), 1e-12)
                cosines = np.abs(np.einsum("nd,nd->n", rays, normals)) / np.sqrt(squares)
                share *= np.maximum(cosines, 0.05) * (np.quantile(squares, 0.05) / squares).clip(0, 1) ** (power / 2)
            found[number].append(points[rng.random(len(points)) < share])
        if all(sum(map(len, parts)) >= wanted for parts in found):
            break
    clouds = [np.concatenate(parts)[:wanted] for parts in found]
    numbers = np.repeat(np.arange(len(views)), [len(cloud) for cloud in clouds])
    return np.concatenate(clouds)[:count], numbers[:count]


def cut_open(points: Float64, rng: Rng) -> Bool:
    """Which points lie on one side of a random plane: 50 % to 90 % of them."""
    along = points @ rng.normal(size=3)
    kept: Bool = along <= np.quantile(along, rng.uniform(0.5, 0.9))
    return kept


# --- Noise: deviation is a number or one per point, (n, 1); all kinds have it as the root mean square per coordinate


def gaussian(points: Float64, deviation: float | Float64, rng: Rng) -> Float64:
    """Every coordinate moves by N(0, deviation)."""
    moved: Float64 = points + deviation * rng.normal(size=points.shape)
    return moved


def uniform_ball(points: Float64, deviation: float | Float64, rng: Rng) -> Float64:
    """Every point moves by a vector drawn evenly from a ball of radius √5 · deviation."""
    moves = rng.normal(size=points.shape)
    moves *= np.cbrt(rng.random((len(points), 1))) / np.linalg.norm(moves, axis=1, keepdims=True)
    moved: Float64 = points + np.sqrt(5) * deviation * moves
    return moved


def laplace(points: Float64, deviation: float | Float64, rng: Rng) -> Float64:
    """Every coordinate moves by a Laplace variable of this standard deviation: heavier tails than Gaussian."""
    moved: Float64 = points + deviation * rng.laplace(scale=np.sqrt(0.5), size=points.shape)
    return moved


def along_rays(points: Float64, deviation: float | Float64, rng: Rng, rays: Float64) -> Float64:
    """Points move along their (n, 3) unit view rays, and a tenth as much in the other directions."""
    moves = np.sqrt(3) * rng.normal(size=(len(points), 1)) * rays + 0.1 * rng.normal(size=points.shape)
    moved: Float64 = points + deviation * moves
    return moved


def anisotropic(points: Float64, deviation: float | Float64, rng: Rng) -> Float64:
    """Gaussian noise with other deviations along three random perpendicular axes."""
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    scales = np.exp(rng.uniform(np.log(0.2), 0, 3))
    scales *= np.sqrt(3) / np.linalg.norm(scales)
    moved: Float64 = points + deviation * ((rng.normal(size=points.shape) * scales) @ axes)
    return moved


def impulsive(points: Float64, deviation: float | Float64, rng: Rng) -> Float64:
    """One point in ten moves, with √10 · deviation; the others stay."""
    hit = rng.random((len(points), 1)) < IMPULSE_SHARE
    moves = deviation * rng.normal(size=points.shape) / np.sqrt(IMPULSE_SHARE)
    return points + np.where(hit, moves, 0.0)


_NOISES: tuple[Noise, ...] = (
    uniform_ball,
    laplace,
    anisotropic,
    impulsive,
)


def smooth_factor(points: Float64, rng: Rng) -> Float64:
    """(n, 1) factors between 0.2 and 1.8 that vary smoothly over the cloud."""
    wave = np.sin(points @ (rng.normal(size=3) * rng.uniform(2, 8)) + rng.uniform(0, 2 * np.pi))
    factors: Float64 = 1 + rng.uniform(0.3, 0.8) * wave[:, None]
    return factors


# --- Other defects ------------------------------------------------------------------------------------------------


def misregistered(points: Float64, view: NDArray[np.int64], level: float, rng: Rng) -> Float64:
    """The points of each view point shifted as a whole, by up to `level`."""
    shifts = rng.normal(size=(int(view.max(initial=0)) + 1, 3))
    shifts *= level * rng.random((len(shifts), 1)) / np.linalg.norm(shifts, axis=1, keepdims=True)
    moved: Float64 = points + shifts[view]
    return moved


def quantised(points: Float64, step: float, rng: Rng) -> Float64:
    """Coordinates rounded to a grid of this step with a random origin."""
    origin = rng.uniform(-step, step, 3)
    rounded: Float64 = np.round((points - origin) / step) * step + origin
    return rounded


def with_duplicates(points: Float64, rng: Rng) -> Float64:
    """Up to a tenth of the rows a second time, at random places of the file."""
    copies = rng.integers(len(points), size=int(len(points) * rng.uniform(0, MAX_DUPLICATE_SHARE)))
    doubled = np.concatenate([points, points[copies]])
    return doubled[rng.permutation(len(doubled))]


def with_outliers(points: Float64, rng: Rng) -> Float64:
    """Up to 2 % of the points replaced by ones drawn from the bounding box, enlarged by a tenth."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.05 * (high - low)
    hit = rng.random((len(points), 1)) < rng.uniform(0.001, MAX_OUTLIER_SHARE)
    return np.where(hit, rng.uniform(low - margin, high + margin, points.shape), points)
