"""What the speed benchmark says about its figures: a line a row, and what the rows say about each other."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

Figures = dict[str, Any]

ITERATIONS = 2
CLASSIC_POINTS = 100_000


def _name(row: Figures) -> str:
    name = row.get("method") or row.get("model") or "paper's network"
    return f"{row['what']:11}{name:28}{row.get('device', ''):9}" + (
        f"{row['threads']} threads  " if "threads" in row else " " * 11
    )


def line(row: Figures) -> str:
    if row["what"] == "network":
        figures = (
            f"{row['patches_per_second']:8.0f} patches/s of {row['patch_points']} points, {row['gflops']:6.1f} GFLOP/s,"
            f" {row['share']:.0%} of sgemm's {row['sgemm_gflops']:.1f}"
        )
    elif row["what"] == "end_to_end":
        stages = ", ".join(
            f"{name} {row[name]:.2f}" for name in ("read", "index", "balls", "patches", "network", "write")
        )
        figures = (
            f"{row['points']:8d} points × {ITERATIONS}: {row['seconds']:7.2f} s ({stages}); not the network "
            f"{row['not_network']:.0%}; peak {row['peak_mb']:.0f} MB"
        )
    elif row["what"] == "served":
        others = f"the library {row['library_seconds']:.2f} s; two at once {row['two_seconds']:.2f} s"
        figures = f"{row['points']:8d} points × {ITERATIONS}: {row['seconds']:7.2f} s; {others}"
    else:
        scaled = f", scaled from {row['sample']} points" if "sample" in row else ""
        figures = f"{row['points']:8d} points: {row['seconds']:8.1f} s{scaled}"
    scores = f"; CD {row['cd']:.3f}, P2F {row['p2f']:.3f}" if "cd" in row else ""
    stolen = f"; {row['stolen']:.0%} of the CPUs' time went to the host's others" if row["stolen"] >= 0.02 else ""
    return _name(row) + figures + scores + stolen


def ratios(table: list[Figures]) -> Iterator[str]:
    """What the rows say about each other."""
    runs = [row for row in table if row["what"] == "end_to_end"]
    for run in (run for run in runs if run["points"] == CLASSIC_POINTS):
        same = [row for row in table if (row.get("model"), row.get("device")) == (run["model"], run["device"])]
        for said in itertools.chain(
            _against_the_bound(run, same), _against_others(run, table), _against_larger(run, same), _served(same)
        ):
            yield f"{run['model']} ({run['device']}): {said}"


def _against_the_bound(run: Figures, same: list[Figures]) -> Iterator[str]:
    for row in same:
        if row["what"] == "network" and row["threads"] == run["threads"]:
            gflops = row["gflops"] / row["patches_per_second"] * run["points"] * ITERATIONS
            ratio = run["seconds"] / (gflops / row["sgemm_gflops"])
            yield f"{ratio:.2f} times the seconds that its products would take at sgemm's rate"


def _against_others(run: Figures, table: list[Figures]) -> Iterator[str]:
    for other in table:
        ratio = other.get("seconds", 0.0) / run["seconds"]
        if other["what"] == "naive" and (not other["model"] or other["widths"] == run["widths"]):
            network = "the same network" if other["model"] else "the paper's network"
            yield f"{ratio:.1f} times as fast as the naive way with {network}, {other['patch_points']} points a patch"
        if other["what"] == "classic":
            accurate = other["cd"] <= run["cd"] and other["p2f"] <= run["p2f"]
            verdict = "less accurate" if not accurate else "beaten" if ratio > 1 else "NOT BEATEN"
            yield f"{other['method']} takes {ratio:.2f} times as long: {verdict}"


def _against_larger(run: Figures, same: list[Figures]) -> Iterator[str]:
    for big in same:
        if big["what"] == "end_to_end" and big["points"] > run["points"]:
            slower = big["seconds"] / big["points"] / (run["seconds"] / run["points"])
            yield f"a point of {big['points']} takes {slower:.2f} times as long as one of {run['points']}"


def _served(same: list[Figures]) -> Iterator[str]:
    for row in same:
        if row["what"] == "served":
            yield f"the service takes {row['seconds'] / row['library_seconds'] - 1:+.1%} of the library's time on top"
            yield f"two requests at once take {row['two_seconds'] / row['seconds']:.2f} times as long as one"


def compared(now: Figures, before: Figures) -> Iterator[str]:
    """Ratios to an earlier run, row for row."""
    yield f"against {before['machine']}:"

    def key(row: Figures) -> tuple[Any, ...]:
        return tuple(row.get(name) for name in ("what", "model", "method", "device", "threads", "points"))

    earlier = {key(row): row for row in before["rows"]}
    for row in now["rows"]:
        if (old := earlier.get(key(row))) is not None:
            figure = "patches_per_second" if row["what"] == "network" else "seconds"
            yield f"{_name(row)}{figure}: {row[figure] / old[figure]:.2f} times what it was"
