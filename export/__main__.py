"""Turn a checkpoint into a bundle that the command line and the service can load.

    python -m export                                        # the newest run: runs/NAME -> bundles/NAME
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

from export.bundle import ParityError, RoundingError, write_bundle
from export.checkpoint import load_checkpoint


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m export", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", type=Path, nargs="?", help="default: the newest runs/*/checkpoint.pt")
    parser.add_argument(
        "--out", type=Path, metavar="FOLDER", help="the bundle; its name names the model (default: bundles/RUN)"
    )
    parser.add_argument("--version", default="0", help="of the weights, kept in model.json (default: %(default)s)")
    parser.add_argument(
        "--int8",
        action="store_true",
        help="8-bit integers in the encoder: about twice as fast, all but the same answers",
    )
    parser.add_argument("--scores", type=Path, metavar="JSON", help="benchmark results to keep in model.json")
    options = parser.parse_args(arguments)
    try:
        scores = json.loads(options.scores.read_text()) if options.scores else None
        checkpoint = options.checkpoint or newest_checkpoint(Path("runs"))
        folder = options.out or Path("bundles", checkpoint.resolve().parent.name)
        loaded = load_checkpoint(checkpoint)
        bundle, difference = write_bundle(loaded, folder, options.version, scores, options.int8)
    except (ValueError, OSError, ParityError, RoundingError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{bundle.folder}: {bundle.parameters} parameters; torch and onnxruntime differ by {difference:.2g} r")
    return 0


def newest_checkpoint(runs: Path) -> Path:
    """The checkpoint that was written last. Raises FileNotFoundError where there is none."""
    found = sorted(runs.glob("*/checkpoint.pt"), key=lambda path: path.stat().st_mtime)
    if not found:
        raise FileNotFoundError(f"no checkpoint in {runs}/: train first, or name one")
    return found[-1]


if __name__ == "__main__":
    sys.exit(main())
