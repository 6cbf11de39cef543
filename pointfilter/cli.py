"""The command line: `pointfilter filter IN OUT` and what goes with it.

Exit codes: 0 done; 2 wrong usage or a parameter out of range; 3 the input file or cloud cannot be filtered; 4 the model
or the device is not usable; 5 a file cannot be opened or written; 130 interrupted. Progress and errors go to stderr,
results to stdout.
"""

from __future__ import annotations

import argparse
import errno
import json
import os
import platform
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pointfilter
from pointfilter import errors
from pointfilter.attributes import COLUMNS, KEEP, NORMALS, parse_columns
from pointfilter.cloud import PointCloud
from pointfilter.engine import DEVICES, Engine, available_cpus
from pointfilter.evaluation import evaluate
from pointfilter.formats import FORMATS, format_of
from pointfilter.formats.ply_header import ENCODINGS
from pointfilter.inspection import CANNOT_TELL, look
from pointfilter.models import (
    DEFAULT_MODEL,
    available_models,
    find_model,
    load_bundle,
    open_model,
    parse_iterations,
)
from pointfilter.noise import bounding_box_diagonal
from pointfilter.pipeline import Radius, Report, filter_cloud

EXIT_CODES: dict[type[BaseException], int] = {
    errors.ParameterError: 2,
    errors.InputError: 3,
    errors.ModelError: 4,
    errors.ProviderUnavailableError: 4,
    OSError: 5,
    KeyboardInterrupt: 130,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit code."""
    options = build_parser().parse_args(arguments)
    try:
        run: Callable[[argparse.Namespace], int] = options.run
        return run(options)
    except tuple(EXIT_CODES) as error:
        code = next(code for kind, code in EXIT_CODES.items() if isinstance(error, kind))
        print("interrupted" if code == 130 else f"error: {_told(error)}", file=sys.stderr)
        return code


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="pointfilter",
        description="Noisy point clouds in, clean ones out: sharp edges and every attribute kept, nothing to tune.",
        epilog=__doc__.split("\n\n", 1)[1] if __doc__ else None,
    )
    parser.add_argument("--version", action="version", version=f"pointfilter {pointfilter.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    command = commands.add_parser("filter", help="filter a file, or every file of a folder")
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
    command.set_defaults(run=_filter)

    command = commands.add_parser("info", help="what is in a file, how noisy it is, and what the filter would do")
    command.add_argument("input", metavar="FILE", type=Path)
    command.add_argument("--brief", action="store_true", help="what is in the file only: no model is asked")
    command.add_argument("--model", help=f"a bundle's name or folder (default: {DEFAULT_MODEL})")
    command.add_argument("--device", default="auto", help=f"auto, {', '.join(DEVICES)} (default: %(default)s)")
    command.add_argument("--threads", type=int, default=0, metavar="T", help="default: all that this process may use")
    command.add_argument("--json", action="store_true")
    command.set_defaults(run=_info)

    command = commands.add_parser("evaluate", help="errors of a filtered cloud against the clean one")
    command.add_argument("filtered", metavar="FILTERED", type=Path)
    command.add_argument("clean", metavar="CLEAN", type=Path, help="the noise-free cloud")
    command.add_argument("--noisy", type=Path, help="the cloud before filtering: shows by how much the errors fell")
    command.add_argument(
        "--mesh", type=Path, help="the clean surface (.ply with faces), for an exact point-to-surface error"
    )
    command.add_argument("--json", action="store_true")
    command.set_defaults(run=_evaluate)

    command = commands.add_parser("models", help="the models at hand")
    command.add_argument("--json", action="store_true")
    command.set_defaults(run=_models)

    command = commands.add_parser("doctor", help="check this installation with one real inference")
    command.add_argument("--json", action="store_true")
    command.set_defaults(run=_doctor)
    return parser


# --- filter -----------------------------------------------------------------------------------------------------------


def _filter(options: argparse.Namespace) -> int:
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


def model_folders() -> list[Path]:
    """Folders of bundles beside the package's own: POINTFILTER_MODEL_DIR."""
    folder = os.environ.get("POINTFILTER_MODEL_DIR")
    return [Path(folder)] if folder else []


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


# --- the others -------------------------------------------------------------------------------------------------------


def _info(options: argparse.Namespace) -> int:
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
    _show(described, options.json)
    return 0


def _looked(cloud: PointCloud, engine: Engine) -> dict[str, Any]:
    """What the filter would do; a cloud that it refuses has a verdict and a warning only."""
    try:
        return look(cloud, engine).as_dict()
    except errors.InputError as error:
        return {"verdict": CANNOT_TELL, "warnings": [str(error)]}


def _evaluate(options: argparse.Namespace) -> int:
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


def _models(options: argparse.Namespace) -> int:
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


def _doctor(options: argparse.Namespace) -> int:
    import numpy as np
    import onnxruntime
    import scipy

    engine = Engine(find_model(folders=model_folders()))
    started = time.perf_counter()
    engine.warm_up()
    found = {
        "pointfilter": pointfilter.__version__,
        "python": platform.python_version(),
        "machine": platform.machine(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "onnxruntime": onnxruntime.__version__,
        "providers": onnxruntime.get_available_providers(),
        "cpus": available_cpus(),
        "model": engine.bundle.name,
        "provider": engine.provider,
        "first_inference_ms": round(1e3 * (time.perf_counter() - started), 2),
    }
    _show(found, options.json)
    return 0


def _show(described: dict[str, Any], as_json: bool) -> None:
    if as_json:
        print(json.dumps(described))
        return
    width = max(map(len, described))
    for name, value in described.items():
        if isinstance(value, dict):
            for key, entry in value.items():
                text = f"{entry['count']} × {', '.join(entry['properties'])}" if isinstance(entry, dict) else entry
                print(f"{name.ljust(width)}  {_printable(key)}: {_printable(str(text))}")
        elif isinstance(value, list | tuple) and value and isinstance(value[0], str):
            print(f"{name.ljust(width)}  " + ("\n" + " " * (width + 2)).join(map(_printable, value)))
        else:
            print(f"{name.ljust(width)}  {value}")


def _printable(text: str) -> str:
    """Text out of a file, which must not talk to the terminal."""
    return "".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in text)


def _told(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error)
