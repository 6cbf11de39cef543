"""How far the points of each part of a scene lie from the part's surface, before a bundle filtered them and after."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from benchmarks.scenes import SCENES, Part, Scene
from pointfilter.engine import Engine
from pointfilter.filter import Filtered, filter_points

Row = dict[str, Any]
CLEAN_LIMIT = 5e-5  # of its size: a part without noise may be so far from its surface afterwards


def part_rows(names: Iterable[str], engines: Iterable[Engine], known: list[Row]) -> Iterator[Row]:
    """The rows of the named scenes, one a part and bundle, that are not known yet."""
    done = {(row["scene"], row["method"], row["weights"]) for row in known}
    for name in names:
        wanted = [engine for engine in engines if (name, engine.bundle.name, engine.bundle.sha256[:12]) not in done]
        if not wanted:
            continue
        scene = SCENES[name]()
        before = scene.rms(scene.noisy)
        for engine in wanted:
            started = time.perf_counter()
            result = filter_points(
                scene.noisy,
                engine,
                calibration=engine.bundle.calibration,
                patch_points=engine.bundle.patch_points,
                threads=engine.threads,
            )
            seconds = time.perf_counter() - started
            named = {"scene": name, "method": engine.bundle.name, "weights": engine.bundle.sha256[:12]}
            for row in _parts(scene, before, result):
                yield {**named, **row, "seconds": seconds, "passes": result.passes}


def _parts(scene: Scene, before: list[float], result: Filtered) -> Iterator[Row]:
    after = scene.rms(result.points)
    for label, part in enumerate(scene.parts):
        own = scene.labels == label
        yield {
            "part": part.name,
            "points": int(own.sum()),
            "moved": float(result.moved[own].mean()),
            "unit": scene.unit,
            "before": before[label],
            "after": after[label],
            "verdict": verdict(part, before[label], after[label], CLEAN_LIMIT * part.size * scene.scale(part)),
        }


def verdict(part: Part, before: float, after: float, limit: float) -> str:
    """better or worse; a part without noise is kept, or worse where it ends farther than `limit` from its surface."""
    if not part.noisy:
        return "kept" if after <= limit else "worse"
    return "better" if after < before else "worse"


def part_table(rows: list[Row]) -> str:
    """The rows as text: rms distance to the part's surface in the scene's unit."""
    head = f"{'scene':18}{'part':18}{'method':28}{'points':>8}{'moved':>8}{'rms before':>12}{'after':>9}{'ratio':>8}"
    lines = [f"{head}  {'unit':10}{'':8}{'seconds':>8}{'passes':>8}"]
    for scene in dict.fromkeys(row["scene"] for row in rows):
        lines += ["", *(part_line(row) for row in rows if row["scene"] == scene)]
    verdicts = [row["verdict"] for row in rows]
    counts = ", ".join(f"{verdicts.count(name)} {name}" for name in ("better", "kept", "worse"))
    return "\n".join([*lines, "", f"parts: {counts}"])


def part_line(row: Row) -> str:
    named = f"{row['scene']:18}{row['part']:18}{row['method']:28}{row['points']:8d}{row['moved']:8.1%}"
    ratio = row["after"] / row["before"] if row["before"] > 0 else np.nan
    figures = f"{row['before']:12.4f}{row['after']:9.4f}{ratio:8.3f}"
    return f"{named}{figures}  {row['unit']:10}{row['verdict']:8}{row['seconds']:8.1f}{row['passes']:8d}"
