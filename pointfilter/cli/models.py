"""`pointfilter models`: lists the models at hand."""

from __future__ import annotations

import argparse
import json
import sys

from pointfilter import errors
from pointfilter.cli.environment import model_folders
from pointfilter.models import DEFAULT_MODEL, available_models, load_bundle

HELP = "the models at hand"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("--json", action="store_true")


def run(options: argparse.Namespace) -> int:
    bundles = []
    for folder in available_models(model_folders()).values():
        try:
            bundles.append(load_bundle(folder))
        except errors.ModelError as error:
            print(f"left out: {error}", file=sys.stderr)
    if options.json:
        print(json.dumps([bundle.summary() for bundle in bundles]))
        return 0
    for bundle in bundles:
        default = " (default)" if bundle.name == DEFAULT_MODEL else ""
        print(
            f"{bundle.name}{default}: version {bundle.version}, {bundle.parameters} weights, "
            f"{bundle.patch_points} points a patch, {'adaptive' if bundle.calibration else 'paper mode'}, "
            f"{bundle.precision}, sha256 {bundle.sha256[:12]}"
        )
    return 0
