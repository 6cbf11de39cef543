"""Accuracy of the bundles and of the classics on clouds with known surfaces: one command, its tables.

    python -m benchmarks.quality --data DIR                          # every bundle, classic, column and scene: hours
    python -m benchmarks.quality --data DIR --models pointfilter-adaptive-int8 --classics --columns '0.5 %' '1 %'
    python -m benchmarks.quality --data DIR --columns 'shapes 1 %' printed --clouds lion busted tp
    python -m benchmarks.quality --data DIR --set shapes --points 10000 400000
    python -m benchmarks.quality --set scenes --models pointfilter-adaptive-int8 --clouds room
    python -m benchmarks.quality --data DIR --json scores.json       # keeps every row; goes on where it stopped
    python -m benchmarks.quality --data DIR --classics --patch-points 64 128 256     # the curve over points a patch

DIR holds paper4/, meshes/, shapes/ and printed/ as subjects.py describes them; any of them may be missing. The data is
not part of this repository: --data or POINTFILTER_BENCHMARK_DATA says where it lies. The scenes (scenes.py) are made by
the benchmark itself.

Rows: noisy; limit, the exact projection of the noisy points onto the surface; every bundle after 1, 2, 4 and auto
iterations; the classics (classics/), each with settings tuned for the noise at hand. Columns: subjects.py.
CD ×1e5, P2F ×1e3, both for a clean cloud scaled to a diagonal of 1 (§4.3); edge: P2F close to sharp edges. In the
column printed, real scans against the meshes that were scanned, the row noisy is the scan as it is. What a classic made
of a cloud is kept in the folder --cache.

After the rows and their means: per bundle, the cells (cloud and column, clean ones aside) that it wins and loses in P2F
against each other row, and the worst; the expected error against the real one, in deciles of the expected. Then the
scenes, part by part, for the bundles alone: the classics' settings are for single objects.
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
from benchmarks.cache import DEFAULT_FOLDER, Cache
from benchmarks.comparison import error_groups, error_table, wins_table
from benchmarks.parts import part_line, part_rows, part_table
from benchmarks.scenes import SCENES
from benchmarks.subjects import COLUMNS, MESH_POINTS, SETS, SHAPE_POINTS, Column, Subject, at_points
from pointfilter.engine import Engine
from pointfilter.filter import Filtered, default_passes, filter_points
from pointfilter.metrics import closest_on_surface
from pointfilter.models import ModelBundle, available_models, open_model
from pointfilter.noise import bounding_box_diagonal

Float64 = NDArray[np.float64]
Row = dict[str, Any]
FIGURES = ("cd", "p2f", "edge", "seconds")
LONGEST = 4  # iterations of the longest row


def main(arguments: list[str] | None = None) -> int:
    parser = _parser()
    options = parser.parse_args(arguments)
    offered = _offered(options.points)
    if unknown := set(options.columns or []) - {column.name for column in offered}:
        parser.error(f"no column {', '.join(sorted(unknown))}; there are {', '.join(c.name for c in offered)}")
    columns = _columns(options)
    scenes = _scenes(options)
    measured = _measured(options.data, columns, options.clouds)
    if not measured and not scenes:
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
    known = json.loads(options.json.read_text()) if options.json and options.json.exists() else {}
    table: list[Row] = known.get("rows", [])
    parts: list[Row] = known.get("scenes", [])

    def keep(rows: list[Row], row: Row, line: str) -> None:
        rows.append(row)
        print("  " + line, file=sys.stderr, flush=True)
        if options.json:
            _save(options.json, table, parts)

    cache = Cache(options.cache)
    for column, subject in measured:
        for row in _rows(subject, column, engines, options.classics, cache, table):
            keep(table, row, _line(row))
    for row in part_rows(scenes, engines, parts):
        keep(parts, row, part_line(row))
    print(_tables(table, columns, [row for row in parts if row["scene"] in scenes]))
    return 0


def _offered(points: list[int]) -> list[Column]:
    """The columns there are, with other densities where those are asked for."""
    if not points:
        return list(COLUMNS)
    return [column for number in dict.fromkeys(points) for column in at_points(COLUMNS, number)]


def _columns(options: argparse.Namespace) -> list[Column]:
    """The columns that are asked for, by name, by set and by density."""
    found = _offered(options.points)
    if options.columns is not None:
        found = [column for column in found if column.name in options.columns]
    if options.set is not None:
        found = [column for column in found if column.subjects in options.set]
    return found


def _scenes(options: argparse.Namespace) -> list[str]:
    """The scenes that are asked for: all of them, unless other sets or columns are named, restricted to --clouds."""
    asked = options.columns is None and not options.points if options.set is None else "scenes" in options.set
    return [name for name in SCENES if asked and name in (options.clouds or [name])]


def _tables(table: list[Row], columns: list[Column], parts: list[Row]) -> str:
    """All that was measured, as text."""
    found = []
    if columns:
        rows = [row for row in table if row["column"] in {column.name for column in columns}]
        noisy = [column.name for column in columns if column.level]
        gaussian = [column.name for column in columns if column.level and column.subjects != "printed"]
        found = [
            report(rows, [column.name for column in columns]),
            wins_table(rows, noisy),
            error_table(rows, gaussian),
        ]
    return "\n\n".join(text for text in [*found, part_table(parts) if parts else ""] if text)


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
        metavar="NAME",
        help="default: all of the sets; " + ", ".join(columns).replace("%", "%%"),
    )
    parser.add_argument("--set", nargs="+", choices=[*SETS, "scenes"], help="measure these alone; default: all")
    parser.add_argument(
        "--points",
        type=_number_of_points,
        nargs="+",
        default=[],
        metavar="N",
        help="draw so many points from every mesh, in place of the densities of the columns",
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
        "--cache",
        type=Path,
        default=DEFAULT_FOLDER,
        help="folder for the results of the classics (default: %(default)s)",
    )
    parser.add_argument(
        "--json", type=Path, help="keep the rows there; those of the same weights are not measured again"
    )
    return parser


def _number_of_points(text: str) -> int:
    points, most = int(text), min(MESH_POINTS, SHAPE_POINTS)
    if not 100 <= points <= most:
        raise argparse.ArgumentTypeError(f"must be from 100 to {most}")
    return points


def _measured(data: Path | None, columns: list[Column], clouds: list[str]) -> list[tuple[Column, Subject]]:
    """Every column with each of its clouds that there is, restricted to `clouds` where some are named."""
    found: dict[str, list[Subject]] = {}
    for name in dict.fromkeys(column.subjects for column in columns):
        folder, load = SETS[name]
        if data is not None and (data / folder).is_dir():
            found[name] = load(data / folder)
        else:
            where = f"in {data}" if data is not None else "known: --data or POINTFILTER_BENCHMARK_DATA names its place"
            print(f"left out: the set {name}: no folder {folder}/ {where}", file=sys.stderr)
    return [
        (column, subject)
        for column in columns
        for subject in found.get(column.subjects, [])
        if subject.name in (column.only or [subject.name]) and subject.name in (clouds or [subject.name])
    ]


def _lengths(bundle: ModelBundle, patch_points: Iterable[int]) -> Iterator[ModelBundle]:
    """The bundle, and the same one with other lengths of patch, named NAME@LENGTH."""
    yield bundle
    for length in patch_points:
        yield dataclasses.replace(bundle, name=f"{bundle.name}@{length}", patch_points=length)


def _rows(
    subject: Subject,
    column: Column,
    engines: Iterable[Engine],
    methods: Iterable[str],
    cache: Cache,
    known: list[Row],
) -> Iterator[Row]:
    """The rows of one cloud in one column that are not known yet."""
    done = {
        (row["method"], row["weights"]) for row in known if (row["column"], row["cloud"]) == (column.name, subject.name)
    }
    clean, noisy = subject.clouds(column)

    def row(
        method: str, points: Float64, seconds: float, weights: str = "", distances: Float64 | None = None, **more: Any
    ) -> Row:
        scores = subject.scores(clean, points, distances)
        named = {"column": column.name, "cloud": subject.name, "method": method, "weights": weights}
        return {**named, **scores, "seconds": seconds, **more}

    if ("noisy", "") not in done:
        yield row("noisy", noisy, 0.0)
    if ("limit", "") not in done:
        yield row("limit", closest_on_surface(noisy, subject.vertices, subject.faces), 0.0)
    for engine in engines:
        name, weights = engine.bundle.name, engine.bundle.sha256[:12]
        if (f"{name} auto", weights) not in done:
            by_iterations, result = _filtered(noisy, engine)
            *shorter, (_, (points, seconds, passes)) = by_iterations.items()
            for iterations, (earlier, until, made) in shorter:
                yield row(f"{name} {iterations}", earlier, until, weights, passes=made)
            distances = subject.distances(clean, points)
            errors = result.errors if points is result.points else np.full(len(points), np.nan)
            groups = error_groups(1e3 * errors / bounding_box_diagonal(clean), 1e3 * distances)
            yield row(f"{name} auto", points, seconds, weights, distances, passes=passes, errors=groups)
    for method in methods:
        if (method, "") not in done:
            points, seconds = cache.smoothed(classics.tuned(method, column.level, len(noisy)), noisy)
            yield row(method, points, seconds)


def _filtered(noisy: Float64, engine: Engine) -> tuple[dict[str, tuple[Float64, float, int]], Filtered]:
    """The cloud after 1, 2, 4 and auto iterations, with seconds and passes, and the result: one run sees them all.

    auto is what the filter does unless told otherwise: as many passes as help, or two in the paper's mode. Passes that
    the filter does not make, because they would not help, leave the result of the one before.
    """
    seen: dict[int, tuple[Float64, float]] = {}
    calibration = engine.bundle.calibration
    automatic = default_passes(calibration)
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
    made = {name: min(passes, result.passes) for name, passes in rows.items()}
    return {name: (*seen[passes], passes) for name, passes in made.items()}, result


def _save(path: Path, table: list[Row], parts: list[Row]) -> None:
    """One row a line."""
    partial = path.with_name(path.name + ".partial")
    lists = {"rows": table, "means": means(table), "scenes": parts}
    texts = [f'"{name}": [\n' + ",\n".join(map(json.dumps, rows)) + "\n]" for name, rows in lists.items()]
    partial.write_text("{" + ",\n".join(texts) + "}\n")
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
    head = f"{'column':20}{'cloud':20}{'method':34}{'CD x1e5':>9}{'P2F x1e3':>10}{'edge x1e3':>10}"
    lines = [f"{head}{'seconds':>9}{'passes':>8}"]
    for rows in (table, means(table)):
        for column in columns:
            lines += ["", *(_line(row) for row in rows if row["column"] == column)]
    return "\n".join(lines)


def _line(row: Row) -> str:
    named = f"{row['column']:20}{row['cloud']:20}{row['method']:34}"
    figures = f"{row['cd']:9.3f}{row['p2f']:10.3f}{row['edge']:10.3f}{row['seconds']:9.1f}"
    return named + figures + (f"{row['passes']:8d}" if "passes" in row else "")


if __name__ == "__main__":
    sys.exit(main())
