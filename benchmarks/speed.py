"""Speed of the bundles, of the whole filter and of what they are compared with: one command, one table.

    python -m benchmarks.speed                                       # 10 k, 100 k and 1 M points: about half an hour
    python -m benchmarks.speed --points 100000 --models pointfilter-adaptive-int8 --classics
    python -m benchmarks.speed --json speed.json                     # and keep the figures
    python -m benchmarks.speed --against speed.json                  # ratios to the figures of an earlier run

Every figure is measured in the run that prints it, in a process of its own, so that its peak of memory is its own too.
Needs no data: the cloud is a ring with sharp edges and 0.5 % noise.

network     real patches of that cloud through the network alone; GFLOP/s count multiplications and additions of its
            layers; share: of the best sgemm (NumPy's) in the same process, with the same number of threads
end_to_end  a binary PLY read, filtered twice, written; stages in seconds of the clock (the work of several threads
            divided by their number; balls: the choice of them, which asks the network too); peak: of the process's
            memory. More than 100 k points: with the default model only, unless others are named
served      the same file through `python -m service`, from the first byte sent to the last one received, alone and
            two at once
naive       research code's way: one patch at a time in Python, then torch in batches of 64; timed on a sample and
            scaled; with each network of the bundles, and with the paper's network and its 500 points
classic     of the quality benchmark, tuned for this noise; not beaten: as accurate as the bundle in CD and P2F, and
            faster
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import itertools
import json
import multiprocessing
import os
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks import classics
from benchmarks.rates import machine, patch_flops, peak_memory, rate, sgemm, stolen_seconds
from benchmarks.speed_report import CLASSIC_POINTS, ITERATIONS, Figures, compared, line, ratios
from benchmarks.subjects import Column, Subject, sample_mesh
from pointfilter.cloud import PointCloud
from pointfilter.engine import Engine, available_cpus
from pointfilter.filter import DEFAULT_RADIUS
from pointfilter.models import DEFAULT_MODEL, available_models, open_model
from pointfilter.network import context, patches_per_batch
from pointfilter.noise import bounding_box_diagonal
from pointfilter.patches import NeighbourIndex
from pointfilter.pipeline import filter_cloud

Float64 = NDArray[np.float64]

NOISE = 0.005
COLUMN = Column("speed", NOISE)
PAPER = {"encoder": [64, 128, 256, 512, 1024], "decoder": [512, 256]}
PAPER_POINTS = 500
NAIVE_SAMPLE = 1024  # points that the naive pipeline is timed on
NAIVE_BATCH = 64


def main(arguments: list[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    against = json.loads(options.against.read_text()) if options.against else None
    table: list[Figures] = []
    for what, values in _plan(options):
        row = _alone(what, **values)
        table.append(row)
        print(line(row), flush=True)
    result = {"machine": machine(), "rows": table}
    for said in [*ratios(table), *(compared(result, against) if against else [])]:
        print(said)
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.speed", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--models", nargs="*", help="names or folders of bundles; default: all that come with this")
    parser.add_argument("--devices", nargs="+", default=["cpu"], help="see pointfilter filter --help")
    parser.add_argument("--points", type=int, nargs="*", default=[10_000, 100_000, 1_000_000])
    parser.add_argument("--threads", type=int, nargs="+", default=sorted({1, available_cpus()}))
    parser.add_argument("--classics", nargs="*", default=list(classics.available()), help="default: all that are there")
    parser.add_argument("--json", type=Path, help="write the figures there")
    parser.add_argument("--against", type=Path, metavar="JSON", help="figures of an earlier run to compare with")
    return parser


def _plan(options: argparse.Namespace) -> Iterator[tuple[Callable[..., Figures], Figures]]:
    """What is measured, in order."""
    most = max(options.threads)
    models = list(available_models()) if options.models is None else options.models
    for model, device, threads in itertools.product(models, options.devices, options.threads):
        yield network, {"model": model, "device": device, "threads": threads}
    for model, device, points in itertools.product(models, options.devices, options.points):
        if points <= CLASSIC_POINTS or options.models is not None or model == DEFAULT_MODEL:
            yield end_to_end, {"model": model, "device": device, "threads": most, "points": points}
    if CLASSIC_POINTS in options.points and importlib.util.find_spec("uvicorn"):
        for model, device in itertools.product(models[:1] if options.models else [DEFAULT_MODEL], options.devices):
            yield served, {"model": model, "device": device, "threads": most}
    if importlib.util.find_spec("torch"):
        for model in {_widths(open_model(model).network): model for model in models}.values():
            yield naive, {"model": model, "threads": most}
        yield naive, {"model": "", "threads": most}
    else:
        print("naive: left out, torch is not installed", file=sys.stderr)
    for method in options.classics:
        if reason := classics.available()[method]:
            print(f"{method}: left out: {reason}", file=sys.stderr)
        else:
            yield classic, {"method": method}


def _alone(measure: Callable[..., Figures], **values: Any) -> Figures:
    """The figures that `measure` returns in a fresh process, with what they are of."""
    # NumPy's products stay in the thread that asks for them; threads are ours to count.
    os.environ.update(OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1", MKL_NUM_THREADS="1")
    context = multiprocessing.get_context("spawn")
    stolen, started = stolen_seconds(), time.perf_counter()
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        figures = pool.submit(measure, **values).result()
    cpu_seconds = (time.perf_counter() - started) * available_cpus()
    return {"what": measure.__name__, **values, **figures, "stolen": (stolen_seconds() - stolen) / cpu_seconds}


def network(model: str, device: str, threads: int) -> Figures:
    """Patches a second of the network alone, in batches as the filter makes them, one thread a batch."""
    bundle = open_model(model)
    engine = Engine(bundle, device, threads)
    _, noisy = ring(20_000).clouds(COLUMN)
    radius = DEFAULT_RADIUS * bounding_box_diagonal(noisy)
    index = NeighbourIndex(noisy, radius)
    size = patches_per_batch(bundle.patch_points)
    batches = [
        index.patches(np.arange(start, start + size), np.full(size, radius), bundle.patch_points, 0)
        for start in range(0, 64 * size, size)
    ]
    centres, owners = np.zeros((size, 3), np.float32), np.arange(size)

    def ask(number: int) -> None:
        batch = batches[number % len(batches)]
        engine(batch.points, context(batch.counts, later=False), centres, owners)

    calls = rate(ask, threads)
    gflops = calls * size * patch_flops(bundle.network, bundle.patch_points) / 1e9
    best = sgemm(threads)
    return {
        "provider": engine.provider,
        "patch_points": bundle.patch_points,
        "patches_per_second": calls * size,
        "gflops": gflops,
        "sgemm_gflops": best,
        "share": gflops / best,
    }


def end_to_end(model: str, device: str, threads: int, points: int) -> Figures:
    """A file in, a file out, with the clock's seconds of every stage and the peak of the process's memory."""
    bundle = open_model(model)
    engine = Engine(bundle, device, threads)
    engine.warm_up()
    subject = ring(points)
    clean, noisy = subject.clouds(COLUMN)
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "in.ply"), Path(folder, "out.ply")
        PointCloud(noisy).write(source)
        del noisy
        started = time.perf_counter()
        cloud = PointCloud.read(source)
        read = time.perf_counter() - started
        filtered, report = filter_cloud(cloud, engine, iterations=ITERATIONS)
        writing = time.perf_counter()
        filtered.write(target, comment=report.comment)
        finished = time.perf_counter()
    memory = peak_memory()  # before the scores, which need memory of their own
    stages = report.seconds
    seconds = finished - started
    infer = stages["infer"] / threads
    return {
        "provider": engine.provider,
        "widths": _widths(bundle.network),
        "seconds": seconds,
        "read": read,
        "index": stages["index"],
        "balls": stages["balls"],
        "patches": stages["patches"] / threads,
        "network": infer,
        "write": finished - writing,
        "not_network": 1 - infer / seconds,
        "peak_mb": memory / 1e6,
        **({name: subject.scores(clean, filtered.xyz)[name] for name in ("cd", "p2f")} if points <= 200_000 else {}),
    }


def served(model: str, device: str, threads: int) -> Figures:
    """Seconds for a file of 100 k points through the service and, in turns with it, through the library, the best of
    two each; and for two files sent at once."""
    engine = Engine(open_model(model), device, threads)
    engine.warm_up()
    _, noisy = ring(CLASSIC_POINTS).clouds(COLUMN)
    values = {"port": free_port(), "model": model, "device": device, "threads": threads, "log_level": "warning"}
    environment = os.environ | {f"POINTFILTER_{name.upper()}": str(value) for name, value in values.items()}
    address = f"http://127.0.0.1:{values['port']}"
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder, "in.ply")
        PointCloud(noisy).write(source)
        body = source.read_bytes()

        def post(_: int = 0) -> int:
            request = urllib.request.Request(f"{address}/filter?iterations={ITERATIONS}", data=body, method="POST")  # noqa: S310
            with urllib.request.urlopen(request) as answer:  # noqa: S310
                return len(answer.read())

        process = subprocess.Popen([sys.executable, "-m", "service"], env=environment)
        try:
            _wait_until_ready(address, process)
            alone = library = float("inf")
            for _ in range(2):
                started = time.perf_counter()
                filtered, report = filter_cloud(PointCloud.read(source), engine, iterations=ITERATIONS)
                filtered.write(Path(folder, "out.ply"), comment=report.comment)
                library = min(library, time.perf_counter() - started)
                started = time.perf_counter()
                post()
                alone = min(alone, time.perf_counter() - started)
            started = time.perf_counter()
            with ThreadPoolExecutor(2) as pool:
                list(pool.map(post, range(2)))
            two = time.perf_counter() - started
        finally:
            process.terminate()
            process.wait()
    return {"points": CLASSIC_POINTS, "seconds": alone, "library_seconds": library, "two_seconds": two}


def free_port() -> int:
    """A port of this machine that nobody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port: int = server.getsockname()[1]
    return port


def _wait_until_ready(address: str, process: subprocess.Popen[bytes]) -> None:
    while process.poll() is None:
        with suppress(OSError), urllib.request.urlopen(f"{address}/health/ready") as answer:  # noqa: S310
            if answer.status == 200:
                return
        time.sleep(0.1)
    raise RuntimeError(f"the service ended with exit code {process.returncode}")


def naive(model: str, threads: int) -> Figures:
    """Seconds for 100 k points in research code's way. model "": the paper's network and patches."""
    import torch

    from training.network import NetworkSettings, Pointfilter

    bundle = open_model(model) if model else None
    settings = NetworkSettings.from_dict(bundle.network if bundle else {**PAPER, "norm_after_pool": False})
    length = bundle.patch_points if bundle else PAPER_POINTS
    torch.set_num_threads(threads)
    net = Pointfilter(dataclasses.replace(settings, adaptive=False)).eval()
    _, points = ring(CLASSIC_POINTS).clouds(COLUMN)
    radius = 0.05 * bounding_box_diagonal(points)
    rng = np.random.default_rng(0)
    rows = rng.choice(len(points), NAIVE_SAMPLE, replace=False)
    tree = cKDTree(points)
    started = time.perf_counter()
    for start in range(0, len(rows), NAIVE_BATCH):
        patches, frames = [], []
        for row in rows[start : start + NAIVE_BATCH]:
            near = np.array(tree.query_ball_point(points[row], radius))
            offsets = (points[near] - points[row]) / radius
            frame = np.linalg.svd(np.cov(offsets.T))[0].T
            if len(offsets) > length:
                offsets = offsets[rng.choice(len(offsets), length, replace=False)]
            patch = np.zeros((length, 3), np.float32)
            patch[: len(offsets)] = offsets @ frame.T
            patches.append(patch)
            frames.append(frame)
        with torch.inference_mode():
            answer = net(torch.from_numpy(np.stack(patches))).numpy()
        points[rows[start : start + NAIVE_BATCH]] += radius * np.einsum("bi,bij->bj", answer, np.stack(frames))
    seconds = (time.perf_counter() - started) / NAIVE_SAMPLE * CLASSIC_POINTS * ITERATIONS
    return {
        "points": CLASSIC_POINTS,
        "patch_points": length,
        "widths": _widths(bundle.network if bundle else PAPER),
        "sample": NAIVE_SAMPLE,
        "seconds": seconds,
    }


def classic(method: str) -> Figures:
    """Seconds and accuracy of a classic filter on 100 k points."""
    subject = ring(CLASSIC_POINTS)
    clean, noisy = subject.clouds(COLUMN)
    started = time.perf_counter()
    filtered = classics.smooth(method, noisy, NOISE)
    seconds = time.perf_counter() - started
    scores = subject.scores(clean, filtered)
    return {"points": CLASSIC_POINTS, "seconds": seconds, "cd": scores["cd"], "p2f": scores["p2f"]}


def ring(points: int) -> Subject:
    """A ring with a square profile and so many points: flat and curved faces that meet in right angles."""
    mesh = trimesh.creation.annulus(r_min=0.3, r_max=0.5, height=0.3, sections=512)
    return sample_mesh("ring", np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int64), points)


def _widths(network: Figures) -> str:
    return "-".join(map(str, [*network["encoder"], *network["decoder"]]))


if __name__ == "__main__":
    sys.exit(main())
