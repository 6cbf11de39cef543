"""`pointfilter info`: describes a file, its noise and what the filter would do."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from pointfilter import errors
from pointfilter.cli.environment import model_folders
from pointfilter.cli.output import show
from pointfilter.cloud import PointCloud
from pointfilter.engine import DEVICES, Engine
from pointfilter.inspection import CANNOT_TELL, look
from pointfilter.models import DEFAULT_MODEL, open_model
from pointfilter.noise import bounding_box_diagonal

HELP = "what is in a file, how noisy it is, and what the filter would do"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("input", metavar="FILE", type=Path)
    command.add_argument("--brief", action="store_true", help="what is in the file only: no model is asked")
    command.add_argument("--model", help=f"a bundle's name or folder (default: {DEFAULT_MODEL})")
    command.add_argument("--device", default="auto", help=f"auto, {', '.join(DEVICES)} (default: %(default)s)")
    command.add_argument("--threads", type=int, default=0, metavar="T", help="default: all that this process may use")
    command.add_argument("--json", action="store_true")


def run(options: argparse.Namespace) -> int:
    cloud = PointCloud.read(options.input)
    finite = cloud.xyz[cloud.finite]
    described: dict[str, Any] = {
        "file": str(options.input),
        "points": len(cloud),
        "without_a_place": len(cloud) - len(finite),
        "low": finite.min(axis=0).tolist() if len(finite) else None,
        "high": finite.max(axis=0).tolist() if len(finite) else None,
        "diagonal": bounding_box_diagonal(finite),
        **(cloud.source.summary if cloud.source else {}),
    }
    if not options.brief:
        engine = Engine(open_model(options.model, model_folders()), options.device, options.threads)
        described.update(_looked(cloud, engine))
    show(described, options.json)
    return 0


def _looked(cloud: PointCloud, engine: Engine) -> dict[str, Any]:
    """What the filter would do; a cloud that it refuses has a verdict and a warning only."""
    try:
        return look(cloud, engine).as_dict()
    except errors.InputError as error:
        return {"verdict": CANNOT_TELL, "warnings": [str(error)]}
