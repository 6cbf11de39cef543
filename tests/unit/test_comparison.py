"""What the quality benchmark says of its rows: cells won and lost, expected against real errors."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("trimesh", reason="the benchmarks extra is not installed")

from benchmarks.comparison import deciles, error_groups, error_table, largest_deviation, p2f_by_cell, wins_table
from benchmarks.quality import Row


def row(column: str, cloud: str, method: str, p2f: float, weights: str = "", **more: object) -> Row:
    return {"column": column, "cloud": cloud, "method": method, "p2f": p2f, "weights": weights, **more}


TABLE = [
    row("1 %", "cube", "noisy", 9.0),
    row("1 %", "cube", "limit", 0.0),
    row("1 %", "cube", "ours 1", 1.5, "abc"),
    row("1 %", "cube", "ours auto", 1.0, "abc"),
    row("1 %", "cube", "jet", 2.0),
    row("1 %", "cube", "mls", 0.8),
    row("1 %", "lion", "noisy", 8.0),
    row("1 %", "lion", "ours auto", 3.0, "abc"),
    row("1 %", "lion", "jet", 2.0),
    row("clean", "lion", "noisy", 0.0),
    row("clean", "lion", "ours auto", 0.5, "abc"),
]


def test_a_cell_holds_what_competes() -> None:
    cells = p2f_by_cell(TABLE, ["1 %"])
    assert cells == {
        ("1 %", "cube"): {"noisy": 9.0, "ours auto": 1.0, "jet": 2.0, "mls": 0.8},
        ("1 %", "lion"): {"noisy": 8.0, "ours auto": 3.0, "jet": 2.0},
    }


def test_wins_losses_and_the_worst_cell() -> None:
    lines = [line.split() for line in wins_table(TABLE, ["1 %"]).splitlines()[1:]]
    assert [line[2:6] for line in lines[:3]] == [
        ["noisy", "2", "0", "0.375"],
        ["jet", "1", "1", "1.500"],
        ["mls", "0", "1", "1.250"],
    ]
    assert lines[3] == ["ours", "auto", "the", "best", "other", "0", "2", "1.500", "lion,", "1", "%"]


def test_groups_are_sorted_by_the_expected_error_and_count_the_unknown() -> None:
    rng = np.random.default_rng(0)
    expected = rng.random(5000)
    expected[:7] = np.nan
    groups = error_groups(expected, 2 * expected)
    assert groups["unknown"] == 7
    assert sum(groups["points"]) == 4993
    assert groups["expected"] == sorted(groups["expected"])
    np.testing.assert_allclose(groups["real"], 2 * np.array(groups["expected"]))
    assert error_groups(np.full(3, np.nan), np.ones(3)) == {"points": [], "expected": [], "real": [], "unknown": 3}


def test_deciles_are_those_of_all_points_together() -> None:
    rng = np.random.default_rng(0)
    clouds = [(scale * rng.random(count), count) for scale, count in ((1.0, 20_000), (3.0, 60_000))]
    factor = 1.3
    pooled = [error_groups(expected, factor * expected) for expected, _ in clouds]
    means = deciles(pooled)
    together = np.sort(np.concatenate([expected for expected, _ in clouds]))
    exact = np.array([part.mean() for part in np.array_split(together, 10)])
    np.testing.assert_allclose(means[:, 0], exact, rtol=0.02)
    np.testing.assert_allclose(means[:, 1], factor * means[:, 0])
    assert largest_deviation(means) == pytest.approx(0.3)


def test_the_table_of_errors_pools_the_default_rows() -> None:
    errors = error_groups(np.linspace(1, 2, 1000), 0.8 * np.linspace(1, 2, 1000))
    table = [
        row("1 %", "cube", "ours auto", 1.0, "abc", errors=errors),
        row("1 %", "lion", "ours auto", 1.0, "abc", errors=errors),
        row("clean", "lion", "ours auto", 1.0, "abc", errors=error_groups(np.ones(10), np.zeros(10))),
        row("1 %", "cube", "paper auto", 1.0, "def", errors=error_groups(np.full(9, np.nan), np.ones(9))),
    ]
    text = error_table(table, ["1 %"])
    assert text.startswith("expected against real error x1e3 of ours auto: 2 clouds, 2000 points, 0 more")
    assert text.endswith("largest deviation 20.0%")
    assert "paper" not in text
