"""What the rows of the quality benchmark say beyond their means: cells won and lost, expected against real errors.

A cell is one cloud in one column. Columns of clean clouds do not count.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Row = dict[str, Any]
Cell = tuple[str, str]  # column, cloud

GROUPS = 200  # of equally many points, that a cloud's expected errors are kept in
DECILES = 10


def p2f_by_cell(table: list[Row], columns: Iterable[str]) -> dict[Cell, dict[str, float]]:
    """(column, cloud) -> method -> P2F: the noisy cloud, the classics and every bundle as it works by default."""
    wanted = set(columns)
    cells: dict[Cell, dict[str, float]] = {}
    for row in table:
        if row["column"] in wanted and row["method"] != "limit" and (not row["weights"] or _is_default(row)):
            cells.setdefault((row["column"], row["cloud"]), {})[row["method"]] = row["p2f"]
    return cells


def _is_default(row: Row) -> bool:
    return bool(row["weights"]) and row["method"].endswith(" auto")


def default_methods(table: list[Row]) -> list[str]:
    """Every bundle's row as it works by default."""
    return list(dict.fromkeys(row["method"] for row in table if _is_default(row)))


def wins_table(table: list[Row], columns: Iterable[str]) -> str:
    """Per bundle: in how many cells its P2F is below and above each other row's, and where it compares worst."""
    cells = p2f_by_cell(table, columns)
    lines = [f"{'P2F by cell':34}{'against':34}{'wins':>6}{'losses':>8}{'worst ratio':>13}  cell"]
    for ours in default_methods(table):
        own = {cell: scores for cell, scores in cells.items() if ours in scores}
        for other in dict.fromkeys(name for scores in own.values() for name in scores if name != ours):
            ratios = {cell: _ratio(s[ours], s[other]) for cell, s in own.items() if other in s}
            lines.append(_wins_line(ours, other, ratios))
        ratios = {
            cell: _ratio(scores[ours], min(value for name, value in scores.items() if name != ours))
            for cell, scores in own.items()
            if len(scores) > 1
        }
        if ratios:
            lines.append(_wins_line(ours, "the best other", ratios))
    return "\n".join(lines)


def _ratio(ours: float, other: float) -> float:
    return ours / other if other > 0 else float("inf") if ours > 0 else 1.0


def _wins_line(ours: str, other: str, ratios: dict[Cell, float]) -> str:
    wins = sum(ratio < 1 for ratio in ratios.values())
    losses = sum(ratio > 1 for ratio in ratios.values())
    worst = max(ratios, key=ratios.__getitem__)
    return f"{ours:34}{other:34}{wins:6d}{losses:8d}{ratios[worst]:13.3f}  {worst[1]}, {worst[0]}"


def error_groups(expected: Float64, real: Float64) -> Row:
    """What is kept of the expected and real errors (n,) of a cloud: means of GROUPS groups, sorted by expectation.

    Points without an expected error are counted as `unknown` and are in no group.
    """
    known = np.flatnonzero(np.isfinite(expected))
    order = known[np.argsort(expected[known], kind="stable")]
    groups = [group for group in np.array_split(order, GROUPS) if len(group)]
    return {
        "points": [len(group) for group in groups],
        "expected": [float(expected[group].mean()) for group in groups],
        "real": [float(real[group].mean()) for group in groups],
        "unknown": len(expected) - len(known),
    }


def deciles(pooled: Iterable[Row]) -> Float64:
    """(10, 2): mean expected and mean real error of each decile of the expected, over the groups of several clouds.

    A group belongs to the decile in which its middle point lies.
    """
    rows = np.concatenate(
        [np.empty((0, 3)), *(np.column_stack([row["points"], row["expected"], row["real"]]) for row in pooled)]
    )
    counts, values = rows[:, 0], rows[:, 1:]
    order = np.argsort(values[:, 0], kind="stable")
    counts, values = counts[order], values[order]
    middles = (np.cumsum(counts) - counts / 2) / max(counts.sum(), 1)
    decile = np.minimum((middles * DECILES).astype(int), DECILES - 1)
    found = np.full((DECILES, 2), np.nan)
    for number in np.unique(decile):
        own = decile == number
        found[number] = np.average(values[own], axis=0, weights=counts[own])
    return found


def largest_deviation(means: Float64) -> float:
    """By how much the real error of a decile differs from the expected one, at most; a share of the expected one."""
    return float(np.nanmax(np.abs(means[:, 1] / means[:, 0] - 1)))


def error_table(table: list[Row], columns: Iterable[str]) -> str:
    """Expected against real errors of every bundle that expects errors, over all its noisy clouds; as P2F ×1e3."""
    wanted = set(columns)
    lines = []
    for method in default_methods(table):
        rows = [row for row in table if row["method"] == method and row["column"] in wanted and row.get("errors")]
        pooled = [row["errors"] for row in rows if row["errors"]["points"]]
        if not pooled:
            continue
        means = deciles(pooled)
        points, unknown = (sum(np.sum(errors[name]) for errors in pooled) for name in ("points", "unknown"))
        lines += [
            f"expected against real error x1e3 of {method}: {len(pooled)} clouds, {points:.0f} points"
            f", {unknown:.0f} more without an expected error",
            f"{'decile':>8}{'expected':>11}{'real':>9}{'real / expected':>17}",
        ]
        lines += [f"{n:8d}{e:11.4f}{r:9.4f}{r / e:17.3f}" for n, (e, r) in enumerate(means, start=1)]
        lines += [f"largest deviation {largest_deviation(means):.1%}", ""]
    return "\n".join(lines).rstrip()
