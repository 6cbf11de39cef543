"""Runs every attack of a folder in a process that may not grow: `python -W error -m tests.attacks.run FOLDER`.

Prints one JSON object: by attack's name, the error that came out and the seconds it took.
"""

from __future__ import annotations

import json
import resource
import signal
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from pointfilter import PointCloud, filter_cloud
from pointfilter.adaptive.calibration import Calibration
from pointfilter.network import Answers
from tests.attacks.files import ATTACKS
from tests.clouds import adaptive_pooled

SECONDS = 10  # after so many an attack has won

MEMORY = 256 << 20  # bytes that the process may grow by; the largest file that is read whole has 20 MB


class FakeEngine:
    bundle = SimpleNamespace(
        name="fake",
        version="0",
        sha256="0" * 64,
        patch_points=64,
        calibration=Calibration(
            balls=(24, 96, 384),
            preference=0.0,
            still_weight=1.0,
            margin=0.0,
            passes=2,
            query_reach=0.4,
            error_factor=1.0,
        ),
    )
    provider = "none"
    threads = 1

    def __call__(self, patches: np.ndarray, context: np.ndarray, queries: np.ndarray, owners: np.ndarray) -> Answers:
        return adaptive_pooled(patches, context, queries, owners)


def give_up(*_: object) -> None:
    raise TimeoutError(f"still running after {SECONDS} s")


def main(folder: Path) -> None:
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    results = {}
    signal.signal(signal.SIGALRM, give_up)
    for attack in ATTACKS:
        path, target = folder / "attack.ply", folder / "result.ply"
        attack.write(path)
        # Files are mapped, so what a file itself takes is not counted.
        resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY + path.stat().st_size, resource.RLIM_INFINITY))
        signal.alarm(SECONDS)
        started = time.perf_counter()
        error: BaseException | None = None
        try:
            filter_cloud(PointCloud.read(path), FakeEngine())[0].write(target)
        except Exception as caught:  # noqa: BLE001 - which one it is, is the question
            error = caught
        seconds = time.perf_counter() - started
        signal.alarm(0)
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        results[attack.name] = {
            "error": type(error).__name__ if error else None,
            "message": str(error) if error else "",
            "seconds": seconds,
            "left": sorted(entry.name for entry in folder.iterdir() if entry.name not in ("attack.ply", "result.ply")),
            "written": target.is_file(),
        }
        path.unlink()
        target.unlink(missing_ok=True)
    print(json.dumps(results))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
