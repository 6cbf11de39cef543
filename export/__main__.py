"""Turn a checkpoint into a bundle that the command line and the service can load.

    python -m export runs/mine/checkpoint.pt --out bundles/mine
    pointfilter filter scan.ply clean.ply --model bundles/mine
    POINTFILTER_MODEL_DIR=bundles make serve          # then POST /filter?model=mine

It also takes checkpoints of the paper's authors' published code (a dict with `state_dict`). The export fails, and
writes nothing, when onnxruntime's answer differs from torch's by more than 1e-5 of the radius.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from export.bundle import ParityError, write_bundle
from export.checkpoint import load_checkpoint


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m export", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument(
        "--out", type=Path, required=True, metavar="FOLDER", help="the bundle; its name names the model"
    )
    parser.add_argument("--version", default="0", help="of the weights, kept in model.json (default: %(default)s)")
    parser.add_argument("--iterations", type=int, default=2, help="default of the bundle (default: %(default)s)")
    parser.add_argument("--scores", type=Path, metavar="JSON", help="benchmark results to keep in model.json")
    options = parser.parse_args(arguments)
    try:
        scores = json.loads(options.scores.read_text()) if options.scores else None
        loaded = load_checkpoint(options.checkpoint)
        bundle, difference = write_bundle(loaded, options.out, options.version, options.iterations, scores)
    except (ValueError, OSError, ParityError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{bundle.folder}: {bundle.parameters} parameters; torch and onnxruntime differ by {difference:.2g} r")
    return 0


if __name__ == "__main__":
    sys.exit(main())
