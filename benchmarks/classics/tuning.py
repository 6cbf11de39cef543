"""Scores of a classic filter with its tuned settings and with what is around them.

    python -m benchmarks.classics --data DIR --tune RIMLS --noise 0.005
    python -m benchmarks.classics --data DIR --tune "CGAL jet" --noise 0.01 --points 10000 --rounds 5

DIR: the folder `paper4` of the data of `benchmarks.quality`.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from benchmarks.classics import SETTINGS, Filter, available, tuned
from benchmarks.classics.unit import Float64
from benchmarks.subjects import Column, Subject, load_clouds

TUNING_CLOUDS = ("Tetrahedron", "fandisk_100K")
STEPS = {"sharpness_angle": 1.4, "normal_sigma": 1.4, "sigma_n": 1.4}  # factors down and up; of the others 1.25
FIXED = ("samples", "steps", "refits", "sigma_r")


def variations(settings: Filter) -> Iterator[Filter]:
    """Every setting alone, one step down and up: lengths and counts by a factor, iterations by one."""
    for name, value in asdict(settings).items():
        if name in FIXED:
            continue
        if name in ("iterations", "normal_passes"):
            stride = 1 if value < 8 else value // 2
            choices = [value - stride, value + stride] if value > 1 else [value + stride]
        else:
            factor = STEPS.get(name, 1.25)
            choices = [type(value)(value / factor), type(value)(value * factor)]
        for choice in choices:
            yield replace(settings, **{name: choice})


def tune(method: str, noise: float, points: int | None, folder: Path, rounds: int) -> None:
    """Prints the scores of the nearest tuned settings and of their variations; the best goes into the next round."""
    clouds = _tuning_clouds(folder, noise, points)
    noisy = [subject.scores(clean, cloud) for subject, clean, cloud in clouds]
    best = tuned(method, noise, len(clouds[0][2]))
    known: dict[Filter, float] = {}
    for _ in range(rounds):
        for settings in (best, *variations(best)):
            if settings not in known:
                scores = [subject.scores(clean, settings(cloud)) for subject, clean, cloud in clouds]
                known[settings] = _relative(scores, noisy)
                means = [float(np.mean([score[name] for score in scores])) for name in ("cd", "p2f")]
                print(f"{known[settings]:8.4f}  CD {means[0]:7.3f}  P2F {means[1]:7.3f}  {settings}", flush=True)
        previous, best = best, min(known, key=known.__getitem__)
        if best == previous:
            break
    print(f"best: {best}")


def _tuning_clouds(folder: Path, noise: float, points: int | None) -> list[tuple[Subject, Float64, Float64]]:
    column = Column(f"tuning {noise:g} {points}", noise, points=points)
    chosen = [subject for subject in load_clouds(folder) if subject.name in TUNING_CLOUDS]
    return [(subject, *subject.clouds(column)) for subject in chosen]


def _relative(scores: list[dict[str, float]], noisy: list[dict[str, float]]) -> float:
    """Geometric mean over clouds and over CD and P2F of what is left of the noisy cloud's."""
    ratios = [after[name] / before[name] for after, before in zip(scores, noisy, strict=True) for name in ("cd", "p2f")]
    return math.exp(float(np.mean(np.log(ratios))))


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.classics", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=os.environ.get("POINTFILTER_BENCHMARK_DATA"))
    parser.add_argument("--tune", required=True, choices=list(SETTINGS), metavar="METHOD", help=", ".join(SETTINGS))
    parser.add_argument("--noise", type=float, default=0.005, help="level, a fraction of the diagonal (default: 0.005)")
    parser.add_argument("--points", type=int, help="of each cloud (default: all)")
    parser.add_argument("--rounds", type=int, default=1, help="how often to go on from the best (default: 1)")
    options = parser.parse_args(arguments)
    if options.data is None or not Path(options.data, "mesh").is_dir():
        print("no data: name a folder with clouds and mesh/ by --data or POINTFILTER_BENCHMARK_DATA", file=sys.stderr)
        return 2
    reason = available()[options.tune]
    if reason:
        print(f"{options.tune} is missing here: {reason}", file=sys.stderr)
        return 2
    tune(options.tune, options.noise, options.points, Path(options.data), options.rounds)
    return 0
