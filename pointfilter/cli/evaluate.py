"""`pointfilter evaluate`: measures a filtered cloud against the clean one."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from pointfilter.cloud import PointCloud
from pointfilter.evaluation import evaluate

HELP = "errors of a filtered cloud against the clean one"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("filtered", metavar="FILTERED", type=Path)
    command.add_argument("clean", metavar="CLEAN", type=Path, help="the noise-free cloud")
    command.add_argument("--noisy", type=Path, help="the cloud before filtering: shows by how much the errors fell")
    command.add_argument(
        "--mesh", type=Path, help="the clean surface (.ply with faces), for an exact point-to-surface error"
    )
    command.add_argument("--json", action="store_true")


def run(options: argparse.Namespace) -> int:
    clean = PointCloud.read(options.clean)
    clouds = {"noisy": options.noisy, "filtered": options.filtered}
    rows = {
        name: evaluate(PointCloud.read(path), clean, options.mesh) for name, path in clouds.items() if path is not None
    }
    if options.json:
        print(json.dumps(rows))
        return 0
    names = list(rows["filtered"])
    print("".ljust(12) + "".join(name.rjust(len(name) + 2) for name in names))
    for label, row in rows.items():
        print(label.ljust(12) + "".join(f"{row[name]:.4f}".rjust(len(name) + 2) for name in names))
    if "noisy" in rows:
        falls = [rows["noisy"][name] / max(rows["filtered"][name], 1e-12) for name in names]
        print(
            "fell by".ljust(12)
            + "".join(f"{fall:.2f}x".rjust(len(name) + 2) for name, fall in zip(names, falls, strict=True))
        )
    return 0
