"""Train a Pointfilter network.

    python -m training                                      # the default preset, on procedural shapes
    python -m training --resume                             # after a kill, a reboot, a night
    python -m training --resume --steps 200000              # longer than it was to be
    python -m training --preset smoke                       # the whole chain in minutes
    python -m training --out runs/mine --meshes my_scans/   # your own ply, obj, off, stl
    python -m training --out runs/mine --set data.noise_high=0.01 --set steps=20000

The folder (runs/PRESET unless --out says another) then holds checkpoint.pt (for `python -m export`), stable.pt (from
where the run can be made longer), log.csv (the curve) and settings.json.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

# glibc gives large blocks back to the system at every free and faults them in again at every step; keeping them more
# than doubles the throughput of training on a CPU. Read at process start, hence the exec.
MALLOC_SETTINGS = {"MALLOC_MMAP_THRESHOLD_": "4000000000", "MALLOC_TRIM_THRESHOLD_": "8000000000"}

STOPPED = 130  # the exit status of a run that a signal ended


def parser() -> argparse.ArgumentParser:
    from training.presets import preset_names

    parser = argparse.ArgumentParser(
        prog="python -m training", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="folder of the run (default: runs/PRESET)")
    parser.add_argument("--preset", choices=preset_names(), default="default", help="default: %(default)s")
    parser.add_argument(
        "--resume",
        action="store_true",
        help="go on from the folder's checkpoint, exactly, with its settings: takes neither --set nor --seed",
    )
    parser.add_argument(
        "--steps", type=int, metavar="N", help="with --resume: make the run longer or shorter than it was to be"
    )
    parser.add_argument("--init", type=Path, metavar="CHECKPOINT", help="start from the weights of this checkpoint.pt")
    parser.add_argument("--until", type=int, metavar="STEP", help="stop after this step, with a checkpoint")
    parser.add_argument("--seed", type=int, default=None, help="of weights, shapes, noise and batches (default: 0)")
    data = parser.add_argument_group("data", "procedural shapes unless one of these is given")
    source = data.add_mutually_exclusive_group()
    source.add_argument("--meshes", type=Path, metavar="DIR", help="train on these meshes: ply, obj, off, stl")
    source.add_argument(
        "--clouds",
        type=Path,
        metavar="DIR",
        help="train on clouds as the authors store them: NAME.npy, NAME_normal.npy, NAME_0.005.npy",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change any setting, e.g. loss.eta=0.95 (repeatable)",
    )
    return parser


def _checkpoint(path: Path) -> dict[str, Any]:
    import torch

    from training.train import trained_network

    try:
        state: dict[str, Any] = torch.load(path, weights_only=True)
        trained_network(state)
    except OSError:
        raise
    except Exception as error:  # what torch raises for a file that is no checkpoint differs between its versions
        raise ValueError(f"--init: {path} is no checkpoint of a run") from error
    return state


@contextmanager
def _stopping() -> Iterator[Callable[[], bool]]:
    """Within it SIGTERM and SIGINT end nothing; what it gives says whether one came. A second SIGINT does end it."""
    seen = threading.Event()

    def note(number: int, _frame: object) -> None:
        seen.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)
        print(f"\n{signal.Signals(number).name}: stopping after this batch", file=sys.stderr)

    before = {number: signal.signal(number, note) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield seen.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def main(arguments: list[str] | None = None) -> int:
    options = parser().parse_args(arguments)
    from training.presets import load_preset
    from training.train import start

    folder = options.out or Path("runs", options.preset)
    overrides = list(options.set)
    if options.seed is not None:
        overrides += [f"seed={options.seed}", f"data.seed={options.seed}"]
    try:
        if options.resume and overrides:
            raise ValueError("--resume takes its settings from the checkpoint: leave out --set and --seed")
        if options.steps is not None and not options.resume:
            raise ValueError("--steps changes a run that is resumed; for a new one: --set steps=N")
        if options.resume and not (folder / "checkpoint.pt").is_file():
            raise FileNotFoundError(f"--resume: no checkpoint.pt in {folder}")
        settings = load_preset(options.preset, overrides)
        init = _checkpoint(options.init) if options.init else None
        with _stopping() as stopped:
            run = start(
                folder,
                settings,
                resume=options.resume,
                meshes=options.meshes,
                clouds=options.clouds,
                init=init,
                until=options.until,
                steps=options.steps,
                stop=stopped,
            )
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped between two checkpoints", file=sys.stderr)
        return STOPPED
    if run.step < min(options.until or run.settings.steps, run.settings.steps):
        print(f"stopped at step {run.step}; go on with --out {folder} --resume", file=sys.stderr)
        return STOPPED
    print(f"{run.step} steps, {run.seconds / 3600:.2f} h: {folder / 'checkpoint.pt'}")
    return 0


if __name__ == "__main__":
    if not all(name in os.environ for name in MALLOC_SETTINGS):
        command = [sys.executable, "-m", "training", *sys.argv[1:]]
        os.execve(sys.executable, command, os.environ | MALLOC_SETTINGS)  # noqa: S606 - this very program again
    sys.exit(main())
