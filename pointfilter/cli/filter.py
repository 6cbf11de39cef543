"""`pointfilter filter`: filters a file, every file of a folder, or stdin."""

from __future__ import annotations

import argparse
import errno
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from pointfilter import errors
from pointfilter.attributes import COLUMNS, KEEP, NORMALS, parse_columns
from pointfilter.cli.environment import model_folders
from pointfilter.cloud import PointCloud
from pointfilter.engine import DEVICES, Engine
from pointfilter.formats import FORMATS, format_of
from pointfilter.formats.ply_header import ENCODINGS
from pointfilter.models import DEFAULT_MODEL, open_model, parse_iterations
from pointfilter.pipeline import Radius, Report, filter_cloud

HELP = "filter a file, or every file of a folder"


def add_arguments(command: argparse.ArgumentParser) -> None:
    command.add_argument("input", metavar="IN", help="a .ply file, a folder of them, or - for stdin")
    command.add_argument("output", metavar="OUT", help="the same kind: a file, a folder, or - for stdout")
    command.add_argument(
        "--model", help=f"a bundle's name or folder (default: {DEFAULT_MODEL}); see `pointfilter models`"
    )
    command.add_argument(
        "--iterations",
        type=parse_iterations,
        metavar="N",
        help="most passes over the cloud, or auto for as many as help (the default)",
    )
    command.add_argument(
        "--radius",
        metavar="R",
        help="radius of all balls: 0.02 in the file's unit, or 5%% of the diagonal (default: chosen for each point)",
    )
    command.add_argument(
        "--strength", type=float, default=1.0, metavar="S", help="of each displacement, 0 to 1 (default: %(default)g)"
    )
    command.add_argument(
        "--max-move",
        type=float,
        metavar="D",
        help="longest displacement of a point, in the file's unit (default: none)",
    )
    command.add_argument(
        "--paper",
        action="store_true",
        help="the paper's mode: balls of 5%% of the diagonal, two passes, all points move",
    )
    command.add_argument(
        "--normals",
        default=KEEP,
        choices=NORMALS,
        help="columns nx ny nz: keep them, write the network's, or leave them out (default: %(default)s)",
    )
    command.add_argument(
        "--columns",
        default="",
        metavar="C",
        help=f"columns to add, separated by commas, of {', '.join(COLUMNS)} (default: none)",
    )
    command.add_argument("--seed", type=int, default=0, metavar="S", help="of the downsampling (default: %(default)s)")
    command.add_argument("--device", default="auto", help=f"auto, {', '.join(DEVICES)} (default: %(default)s)")
    command.add_argument("--threads", type=int, default=0, metavar="T", help="default: all that this process may use")
    command.add_argument(
        "--format", default="same", choices=["same", *ENCODINGS], help="encoding of the output (default: %(default)s)"
    )
    command.add_argument("--json", action="store_true", help="print a report as JSON (on stderr when OUT is -)")
    command.add_argument("--quiet", action="store_true", help="no progress")


def run(options: argparse.Namespace) -> int:
    radius = Radius.parse(options.radius) if options.radius is not None else None
    columns = parse_columns(options.columns)
    engine = Engine(open_model(options.model, model_folders()), options.device, options.threads)
    to_stdout = options.output == "-"
    for source, target in _pairs(options.input, options.output):
        with _on_disk(source) as path, _collected(target) as result:
            cloud = PointCloud.read(path)
            with _Progress(str(source), options.quiet) as progress:
                filtered, report = filter_cloud(
                    cloud,
                    engine,
                    iterations=options.iterations,
                    radius=radius,
                    seed=options.seed,
                    strength=options.strength,
                    max_move=options.max_move,
                    paper=options.paper,
                    normals=options.normals,
                    columns=columns,
                    progress=progress,
                )
            filtered.write(result, options.format, report.comment)
        stream = sys.stderr if to_stdout else sys.stdout
        if options.json:
            print(json.dumps({"input": source, "output": target, **report.as_dict()}), file=stream)
        elif not options.quiet:
            print(_summary(source, target, report), file=sys.stderr)
    return 0


def _pairs(source: str, target: str) -> list[tuple[str, str]]:
    """Input and output files: the two given, or one pair for each file of a folder."""
    if source == "-" or not Path(source).is_dir():
        if target != "-" and Path(target).is_dir():
            if source == "-":
                raise errors.ParameterError("the output is a folder, the input is stdin")
            return [(source, str(Path(target) / Path(source).name))]
        return [(source, target)]
    files = sorted(path for path in Path(source).iterdir() if path.suffix.lower() in FORMATS and path.is_file())
    if not files:
        raise errors.UnsupportedFormatError(f"no {', '.join(FORMATS)} file in {source}")
    if target == "-" or Path(target).is_file():
        raise errors.ParameterError("the input is a folder, so the output must be one too")
    Path(target).mkdir(parents=True, exist_ok=True)
    return [(str(path), str(Path(target) / path.name)) for path in files]


@contextmanager
def _on_disk(source: str) -> Iterator[Path]:
    """The input as a file: stdin is spooled to a private one first."""
    if source != "-":
        yield Path(source)
        return
    with tempfile.TemporaryDirectory(prefix="pointfilter-") as folder:
        path = Path(folder) / "stdin.ply"
        with path.open("wb") as file:
            shutil.copyfileobj(sys.stdin.buffer, file)
        yield path


@contextmanager
def _collected(target: str) -> Iterator[Path]:
    """Where to write: the output file itself, or a private one that then goes to stdout."""
    if target != "-":
        format_of(Path(target))  # minutes of work must not end in a wrong suffix or a folder that is not there
        if not Path(target).parent.is_dir():
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(Path(target).parent))
        yield Path(target)
        return
    with tempfile.TemporaryDirectory(prefix="pointfilter-") as folder:
        path = Path(folder) / "stdout.ply"
        yield path
        with path.open("rb") as file:
            shutil.copyfileobj(file, sys.stdout.buffer)
        sys.stdout.buffer.flush()


class _Progress:
    """A line on stderr that rewrites itself; nothing where stderr is no terminal."""

    def __init__(self, label: str, quiet: bool) -> None:
        self._label = label
        self._shown = not quiet and sys.stderr.isatty()
        self._started = time.perf_counter()

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._shown:
            print("\r\033[K", end="", file=sys.stderr, flush=True)

    def __call__(self, done: int, total: int) -> None:
        if self._shown and done:
            left = (time.perf_counter() - self._started) * (total - done) / done
            print(
                f"\r\033[K{self._label}: {100 * done // total} %, {left:.0f} s left",
                end="",
                file=sys.stderr,
                flush=True,
            )


def _summary(source: str, target: str, report: Report) -> str:
    skipped = f", {report.skipped} rows with non-finite coordinates left unchanged" if report.skipped else ""
    expected = f", expected error {report.expected_error:.3g}" if report.expected_error is not None else ""
    lines = [
        f"{source} -> {target}: {report.points} points{skipped}, {report.moved} moved in {report.iterations} passes "
        f"with {report.model}, radius {report.radius_low:.3g} to {report.radius_high:.3g}, mean displacement "
        f"{report.mean_displacement:.3g}{expected}, {report.seconds['total']:.1f} s",
        *(f"warning: {warning}" for warning in report.warnings),
    ]
    return "\n".join(lines)
