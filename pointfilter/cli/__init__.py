"""The command line: `pointfilter filter IN OUT` and what goes with it.

Exit codes: 0 done; 2 wrong usage or a parameter out of range; 3 the input file or cloud cannot be filtered; 4 the model
or the device is not usable; 5 a file cannot be opened or written; 130 interrupted. Progress and errors go to stderr,
results to stdout.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from types import ModuleType

import pointfilter
from pointfilter import errors
from pointfilter.cli import doctor, evaluate, info, models
from pointfilter.cli import filter as filter_command

EXIT_CODES: dict[type[BaseException], int] = {
    errors.ParameterError: 2,
    errors.InputError: 3,
    errors.ModelError: 4,
    errors.ProviderUnavailableError: 4,
    OSError: 5,
    KeyboardInterrupt: 130,
}

# Each command is a module with a line of help and two functions:
# add_arguments(command: argparse.ArgumentParser) -> None
# run(options: argparse.Namespace) -> int, the exit code
COMMANDS: dict[str, ModuleType] = {
    "filter": filter_command,
    "info": info,
    "evaluate": evaluate,
    "models": models,
    "doctor": doctor,
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
    for name, module in COMMANDS.items():
        command = commands.add_parser(name, help=module.HELP)
        module.add_arguments(command)
        command.set_defaults(run=module.run)
    return parser


def _told(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error)
