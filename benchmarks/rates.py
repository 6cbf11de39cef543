"""What a machine can do: products a second, calls a second, memory, and the time its host takes away."""

from __future__ import annotations

import itertools
import os
import platform
import resource
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from pointfilter.engine import available_cpus

Float32 = NDArray[np.float32]

SECONDS = 3.0  # how long a rate is measured
SGEMM_SIZES = (256, 512, 1024, 2048)


def patch_flops(widths: dict[str, Any], points: int) -> float:
    """Multiplications and additions of the network's products for one patch and one query."""
    more, answers = (5, 8) if widths.get("adaptive") else (0, 3)  # inputs beside the features, and outputs
    encoder = [3, *widths["encoder"]]
    decoder = [encoder[-1] + more, *widths["decoder"], answers]

    def products(layers: list[int]) -> int:
        return sum(a * b for a, b in itertools.pairwise(layers))

    return 2.0 * (points * products(encoder) + products(decoder))


def sgemm(threads: int) -> float:
    """GFLOP/s of NumPy's best float32 product, one in every thread at once."""
    best = 0.0
    for size in SGEMM_SIZES:
        matrices = np.random.default_rng(0).random((threads, size, size), np.float32)
        products = np.empty_like(matrices)

        def multiply(number: int, matrices: Float32 = matrices, products: Float32 = products) -> None:
            matrix = matrices[number % threads]
            np.matmul(matrix, matrix, out=products[number % threads])

        best = max(best, rate(multiply, threads, SECONDS / len(SGEMM_SIZES)) * 2 * size**3 / 1e9)
    return best


def rate(call: Callable[[int], object], threads: int, seconds: float = SECONDS) -> float:
    """Calls a second, `threads` of them at a time, each thread with numbers of its own."""

    def work(first: int, until: float) -> int:
        done = 0
        while time.perf_counter() < until:
            call(first + done * threads)
            done += 1
        return done

    with ThreadPoolExecutor(threads) as pool:
        for duration in (0.2, seconds):  # the first round warms up
            started = time.perf_counter()
            counts = [pool.submit(work, number, started + duration) for number in range(threads)]
            done = sum(count.result() for count in counts)
            elapsed = time.perf_counter() - started
    return done / elapsed


def peak_memory() -> float:
    """The most memory that this process has held so far, in bytes. ru_maxrss would know the parent's too."""
    try:
        status = Path("/proc/self/status").read_text()
        return 1024.0 * int(status.partition("VmHWM:")[2].split()[0])
    except (OSError, IndexError):
        return 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def stolen_seconds() -> float:
    """CPU seconds that a virtual machine wanted and its host gave to others, since it was started."""
    try:
        return int(Path("/proc/stat").read_text().split()[8]) / os.sysconf("SC_CLK_TCK")
    except (OSError, IndexError, ValueError):
        return 0.0


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        processor = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        processor = platform.processor()
    return {
        "processor": processor,
        "cpus": available_cpus(),
        "python": platform.python_version(),
        "onnxruntime": onnxruntime.__version__,
        "numpy": np.__version__,
    }
