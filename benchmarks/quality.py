"""Accuracy of the bundles and of the classics on clouds with known surfaces: one command, one table.

    python -m benchmarks.quality --data DIR                          # every bundle, classic and column: hours
    python -m benchmarks.quality --data DIR --models pointfilter-adaptive-int8 --classics --columns '0.5 %' '1 %'
    python -m benchmarks.quality --data DIR --columns 'shapes 1 %' printed --clouds lion busted tp
    python -m benchmarks.quality --data DIR --json scores.json       # keeps every row; goes on where it stopped
    python -m benchmarks.quality --data DIR --classics --patch-points 64 128 256     # the curve over points a patch

DIR holds paper4/, meshes/, shapes/ and printed/ as subjects.py describes them; any of them may be missing. The data is
not part of this repository: --data or POINTFILTER_BENCHMARK_DATA says where it lies.

Rows: noisy; limit, the exact projection of the noisy points onto the surface; every bundle after 1, 2, 4 and auto
iterations; the classics (classics/), each tuned on the paper's clouds for the noise at hand. Columns: subjects.py.
CD ×1e5, P2F ×1e3, both for a clean cloud scaled to a diagonal of 1 (§4.3); edge: P2F close to sharp edges. In the
column printed, real scans against the meshes that were scanned, the row noisy is the scan as it is.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks import classics
from benchmarks.subjects import COLUMNS, SETS, Column, Subject
from pointfilter.engine import Engine
from pointfilter.filter import DEFAULT_ITERATIONS, filter_points
from pointfilter.metrics import closest_on_surface
from pointfilter.models import ModelBundle, available_models, open_model

Float64 = NDArray[np.float64]
Row = dict[str, Any]
FIGURES = ("cd", "p2f", "edge", "seconds")
LONGEST = 4  # iterations of the longest row


def main(arguments: list[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    columns = [column for column in COLUMNS if column.name in options.columns]
    measured = _measured(options.data, columns, options.clouds)
    if not measured:
        named = f" of {', '.join(options.clouds)}" if options.clouds else ""
        print(
            f"no benchmark data{named} for these columns: name a folder that holds one of "
            f"{', '.join(f'{folder}/' for folder, _ in SETS.values())} by --data or POINTFILTER_BENCHMARK_DATA",
            file=sys.stderr,
        )
        return 2
    engines = [Engine(bundle) for name in options.models for bundle in _lengths(open_model(name), options.patch_points)]
    for name, reason in classics.available().items():
        if name in options.classics and reason:
            print(f"left out: {name}: {reason}", file=sys.stderr)
            options.classics.remove(name)
    table: list[Row] = json.loads(options.json.read_text())["rows"] if options.json and options.json.exists() else []
    for column, subject in measured:
        for row in _rows(subject, column, engines, options.classics, table):
            table.append(row)
            print("  " + _line(row), file=sys.stderr, flush=True)
            if options.json:
                _save(options.json, table)
    print(report(table, options.columns))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.quality", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    columns = [column.name for column in COLUMNS]
    parser.add_argument("--data", type=Path, default=os.environ.get("POINTFILTER_BENCHMARK_DATA"))
    parser.add_argument("--models", nargs="*", default=list(available_models()), help="names or folders of bundles")
    parser.add_argument("--classics", nargs="*", default=list(classics.available()), help="default: all that are there")
    parser.add_argument(
        "--columns",
        nargs="+",
        default=columns,
        choices=columns,
        metavar="NAME",
        help=", ".join(columns).replace("%", "%%"),
    )
    parser.add_argument("--clouds", nargs="+", default=[], metavar="NAME", help="measure on these alone; default: all")
    parser.add_argument(
        "--patch-points",
        type=int,
        nargs="+",
        default=[],
        metavar="N",
        help="measure every bundle with at most so many points a patch too",
    )
    parser.add_argument(
        "--json", type=Path, help="keep the rows there; those of the same weights are not measured again"
    )
    return parser


def _measured(data: Path | None, columns: list[Column], clouds: list[str]) -> list[tuple[Column, Subject]]:
    """Every column with each of its clouds that there is, restricted to `clouds` where some are named."""
    found: dict[str, list[Subject]] = {}
    for name in {column.subjects for column in columns}:
        folder, load = SETS[name]
        found[name] = load(Path(data, folder)) if data is not None and Path(data, folder).is_dir() else []
    return [
        (column, subject)
        for column in columns
        for subject in found[column.subjects]
        if subject.name in (column.only or [subject.name]) and subject.name in (clouds or [subject.name])
    ]


def _lengths(bundle: ModelBundle, patch_points: Iterable[int]) -> Iterator[ModelBundle]:
    """The bundle, and the same one with other lengths of patch, named NAME@LENGTH."""
    yield bundle
    for length in patch_points:
        yield dataclasses.replace(bundle, name=f"{bundle.name}@{length}", patch_points=length)


def _rows(
    subject: Subject, column: Column, engines: Iterable[Engine], methods: Iterable[str], known: list[Row]
) -> Iterator[Row]:
    """The rows of one cloud in one column that are not known yet."""
    done = {
        (row["method"], row["weights"]) for row in known if (row["column"], row["cloud"]) == (column.name, subject.name)
    }
    clean, noisy = subject.clouds(column)

    def row(method: str, points: Float64, seconds: float, weights: str = "", **more: int) -> Row:
        scores = subject.scores(clean, points)
        named = {"column": column.name, "cloud": subject.name, "method": method, "weights": weights}
        return {**named, **scores, "seconds": seconds, **more}

    if ("noisy", "") not in done:
        yield row("noisy", noisy, 0.0)
    if ("limit", "") not in done:
        yield row("limit", closest_on_surface(noisy, subject.vertices, subject.faces), 0.0)
    for engine in engines:
        name, weights = engine.bundle.name, engine.bundle.sha256[:12]
        if (f"{name} auto", weights) not in done:
            for iterations, (points, seconds, passes) in _filtered(noisy, engine).items():
                yield row(f"{name} {iterations}", points, seconds, weights, passes=passes)
    for method in methods:
        if (method, "") not in done:
            started = time.perf_counter()
            points = classics.smooth(method, noisy, column.level)
            yield row(method, points, time.perf_counter() - started)


def _filtered(noisy: Float64, engine: Engine) -> dict[str, tuple[Float64, float, int]]:
    """The cloud after 1, 2, 4 and auto iterations, with seconds and passes: one run sees them all.

    auto is what the filter does unless told otherwise: as many passes as help, or two in the paper's mode. Passes that
    the filter does not make, because they would not help, leave the result of the one before.
    """
    seen: dict[int, tuple[Float64, float]] = {}
    calibration = engine.bundle.calibration
    automatic = DEFAULT_ITERATIONS if calibration is None else calibration.passes
    started = time.perf_counter()
    result = filter_points(
        noisy,
        engine,
        calibration=calibration,
        iterations=max(LONGEST, automatic),
        patch_points=engine.bundle.patch_points,
        threads=engine.threads,
        after_pass=lambda passes, points: seen.update({passes: (points, time.perf_counter() - started)}),
    )
    seen[result.passes] = (
        result.points,
        time.perf_counter() - started,
    )  # the choice of balls is all there is to 0 passes
    rows = {**{str(passes): passes for passes in (1, 2, LONGEST)}, "auto": automatic}
    return {name: (*seen[min(passes, result.passes)], min(passes, result.passes)) for name, passes in rows.items()}


def _save(path: Path, table: list[Row]) -> None:
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps({"rows": table, "means": means(table)}, indent=1) + "\n")
    partial.replace(path)


def means(table: list[Row]) -> list[Row]:
    """One row a column and method: the mean over the clouds."""
    found = []
    for column, method, weights in dict.fromkeys((row["column"], row["method"], row["weights"]) for row in table):
        chosen = [row for row in table if (row["column"], row["method"], row["weights"]) == (column, method, weights)]
        values = {name: float(np.mean([row[name] for row in chosen])) for name in FIGURES}
        found.append(
            {"column": column, "cloud": f"mean of {len(chosen)}", "method": method, "weights": weights, **values}
        )
    return found


def report(table: list[Row], columns: Iterable[str]) -> str:
    """The table as text: every cloud, then the means, column by column."""
    head = f"{'column':20}{'cloud':20}{'method':26}{'CD x1e5':>9}{'P2F x1e3':>10}{'edge x1e3':>10}"
    lines = [f"{head}{'seconds':>9}{'passes':>8}"]
    for rows in (table, means(table)):
        for column in columns:
            lines += ["", *(_line(row) for row in rows if row["column"] == column)]
    return "\n".join(lines)


def _line(row: Row) -> str:
    named = f"{row['column']:20}{row['cloud']:20}{row['method']:26}"
    figures = f"{row['cd']:9.3f}{row['p2f']:10.3f}{row['edge']:10.3f}{row['seconds']:9.1f}"
    return named + figures + (f"{row['passes']:8d}" if "passes" in row else "")


if __name__ == "__main__":
    sys.exit(main())
