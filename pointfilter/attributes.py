"""Columns that the filter writes beside x, y and z: normals of the filtered points, and figures on each point."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pointfilter.adaptive.places import distinct_places
from pointfilter.cloud import PointCloud
from pointfilter.errors import ParameterError
from pointfilter.filter import Filtered
from pointfilter.models import DEFAULT_MODEL, ModelBundle
from pointfilter.network import MIN_NEIGHBOURS
from pointfilter.noise import bounding_box_centre

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

KEEP, RECOMPUTE, DROP = "keep", "recompute", "drop"
NORMALS = (KEEP, RECOMPUTE, DROP)
NORMAL_COLUMNS = ("nx", "ny", "nz")

DISPLACEMENT, UNCERTAINTY, OUTLIER = "displacement", "uncertainty", "outlier"
COLUMNS = (DISPLACEMENT, UNCERTAINTY, OUTLIER)
PREFIX = "scalar_"  # CloudCompare's, for columns that are numbers
OUTLIER_SHARE = 0.5  # of the radius of a point's ball: a larger expected error makes it an outlier


# --- normals ----------------------------------------------------------------------------------------------------------


def check_normals(normals: str, bundle: ModelBundle, paper: bool) -> None:
    """Raises ParameterError for a word that is none of NORMALS, and for RECOMPUTE without a network that answers with
    normals."""
    if normals not in NORMALS:
        raise ParameterError(f"normals must be one of {', '.join(NORMALS)}, got {normals[:40]!r}", actual=normals[:40])
    if normals == RECOMPUTE and (paper or bundle.calibration is None):
        reason = "the paper's mode has none" if paper else f"model {bundle.name!r} has none"
        raise ParameterError(
            f"normals={RECOMPUTE} needs a network that answers with normals; {reason}",
            actual=normals,
            hint=f"leave out paper and use an adaptive model such as {DEFAULT_MODEL}, or normals={KEEP} or {DROP}",
        )


def check_normal_columns(cloud: PointCloud, normals: str) -> None:
    """Raises ParameterError where RECOMPUTE cannot write to the cloud's columns nx, ny and nz."""
    found = [name for name in NORMAL_COLUMNS if name in cloud.column_types]
    if normals != RECOMPUTE or not found:
        return
    kinds = [cloud.column_types[name] for name in found]
    if len(found) < len(NORMAL_COLUMNS) or not all(kind is not None and kind.kind == "f" for kind in kinds):
        raise ParameterError(
            f"normals={RECOMPUTE} needs all of nx, ny and nz as float or double, or none of them; the file has "
            + ", ".join(
                f"{name} ({'list' if kind is None else kind.name})" for name, kind in zip(found, kinds, strict=True)
            ),
            actual=", ".join(found),
            hint=f"remove them with normals={DROP} first",
        )


def with_normals(
    cloud: PointCloud, normals: str, finite: Bool, result: Filtered, displacements: Float64
) -> tuple[PointCloud, list[str]]:
    """The cloud with its normals as asked for, and what is worth knowing about them, a sentence each.

    cloud: n points with the filtered coordinates; check_normal_columns has passed. finite: (n,) bool, the m rows that
    were filtered. result: what the filter says of them. displacements: (m,) float64, the lengths of their moves.
    """
    found = [name for name in NORMAL_COLUMNS if name in cloud.column_types]
    if normals == DROP:
        return cloud.without_columns(found), []
    if normals == KEEP:
        if not (found and displacements.any()):
            return cloud, []
        return cloud, [
            f"the file's normals ({', '.join(found)}) are those of the unfiltered points; normals={RECOMPUTE} writes "
            f"new ones, normals={DROP} removes them"
        ]
    old = cloud.column_values(NORMAL_COLUMNS) if found else np.zeros((len(cloud), 3))
    new = np.full((len(cloud), 3), np.nan)
    new[finite] = signed(result.normals, old[finite], cloud.xyz[finite])
    unknown = ~np.isfinite(new).all(axis=1)
    new[unknown] = old[unknown]
    notes = []
    if unknown.any():
        given = "keep their old normal" if found else "have the normal 0 0 0"
        notes.append(
            f"{unknown.sum()} rows got no normal from the network, as where too few points are around, and {given}"
        )
    return cloud.with_columns(dict(zip(NORMAL_COLUMNS, new.T, strict=True))), notes


def signed(normals: Float64, old: Float64, points: Float64) -> Float64:
    """The normals (n, 3), each on the side of the old one (n, 3); where that is 0, not finite or perpendicular, away
    from the centre of the bounding box of the points (n, 3)."""
    outward = np.einsum("ij,ij->i", normals, points - bounding_box_centre(points))
    agreement = np.einsum("ij,ij->i", normals, np.nan_to_num(old, nan=0.0, posinf=0.0, neginf=0.0))
    return np.where((np.where(agreement == 0, outward, agreement) < 0)[:, None], -normals, normals)


# --- figures on each point --------------------------------------------------------------------------------------------


def parse_columns(text: str) -> tuple[str, ...]:
    """Some of COLUMNS, comma separated, each once and in their order; none for an empty text. Raises ParameterError."""
    return checked_columns([word.strip() for word in text.split(",")] if text.strip() else [])


def checked_columns(columns: Sequence[str]) -> tuple[str, ...]:
    """Some of COLUMNS, each once and in their order. Raises ParameterError."""
    for name in columns:
        if name not in COLUMNS:
            raise ParameterError(
                f"columns must be some of {', '.join(COLUMNS)}, separated by commas, got {name[:40]!r}",
                actual=name[:40],
            )
    return tuple(name for name in COLUMNS if name in columns)


def check_new_columns(cloud: PointCloud, columns: Sequence[str]) -> None:
    """Raises ParameterError where the cloud has a column of a name that would be added."""
    for name in columns:
        if PREFIX + name in cloud.column_types:
            raise ParameterError(
                f"the file has a column {PREFIX}{name} already, which would be overwritten",
                actual=PREFIX + name,
                hint=f"rename or remove the column, or leave {name} out of columns",
            )


def with_figures(
    cloud: PointCloud, columns: Sequence[str], finite: Bool, points: Float64, result: Filtered, displacements: Float64
) -> tuple[PointCloud, list[str]]:
    """The cloud with a column for each of `columns`, and what is worth knowing about them, a sentence each.

    cloud, finite, result, displacements: as for with_normals. points: (m, 3), the rows before filtering.

    scalar_displacement: length of the move. scalar_uncertainty: expected distance to the surface after filtering; NaN
    where the filter does not know it, as where too few points are around, and where the move was shortened.
    scalar_outlier: 1 where the point took no ball, or one of fewer than MIN_NEIGHBOURS points, or where the expected
    error after the unlimited move is larger than OUTLIER_SHARE of the radius of its ball; else 0.
    """
    added = {}
    for name in columns:
        values, elsewhere = _figures(name, points, result, displacements)
        added[PREFIX + name] = np.full(len(cloud), elsewhere)
        added[PREFIX + name][finite] = values
    notes = []
    if UNCERTAINTY in columns and not np.isfinite(added[PREFIX + UNCERTAINTY]).any():
        notes.append(f"no expected error is known of any point, so {PREFIX}{UNCERTAINTY} is NaN everywhere")
    return cloud.with_columns(added), notes


def _figures(name: str, points: Float64, result: Filtered, displacements: Float64) -> tuple[Float64, float]:
    """The values (m,) of one of COLUMNS, and that of rows that were not filtered."""
    if name == DISPLACEMENT:
        return displacements, 0.0
    if name == UNCERTAINTY:
        shortened = displacements < (1 - 1e-9) * np.linalg.norm(result.points - points, axis=1)
        return np.where(shortened, np.nan, result.errors), np.nan
    outlier = _too_few_in_ball(points, result) | (result.errors > OUTLIER_SHARE * result.radii)
    return outlier.astype(np.float64), 1.0


def _too_few_in_ball(points: Float64, result: Filtered) -> Bool:
    """(m,) bool: whether a point took no ball, or one that holds fewer than MIN_NEIGHBOURS distinct points.

    Only points without an expected error are looked at: the filter tells no error of such balls.
    """
    few = np.isnan(result.radii)
    unknown = np.flatnonzero(~few & np.isnan(result.errors))
    if len(unknown):
        distances, _ = cKDTree(distinct_places(points).points).query(points[unknown], k=[MIN_NEIGHBOURS])
        few[unknown] = distances[:, 0] > result.radii[unknown]
    return few
