"""The service under more load than it can take, with clients that vanish and workers that are killed.

    python -m benchmarks.load                                     # 60 s at 1 and at 10 times what it can do
    python -m benchmarks.load --seconds 600 --factors 10 --kill-every 5 --kill-service-every 60 --json soak.json

Starts the service by itself on the loopback interface, with a queue and a data folder of its own, and starts it again
when it was killed. Clouds come at random times (a Poisson process), whether or not earlier ones are done; half of them
as requests, half as jobs; one client in ten vanishes. Every result is compared, byte for byte, with what the service
answered when it was idle; every job that was accepted must be done in the end, once.

Prints what it measured: throughput, latency of what was answered well, how the rest ended, latency of /health/live
while the service is up, memory of the service and its workers. Exit code 1 when a job was lost, a byte was wrong, an
answer was none that is documented or came too late, or a bar on /health/live or memory was not met.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx2 as httpx
import numpy as np

from benchmarks.speed import COLUMN, free_port, ring
from pointfilter.cloud import PointCloud

POINTS = 2_000
VANISHING = 0.1
JOBS = 0.5
LIVE_SECONDS = 0.1
LIVE_TIMEOUT_SECONDS = 5.0
ANSWER_SECONDS = 120.0
LIVE_BAR = 0.1  # seconds, of the 99th percentile
MEMORY_BAR = 1.1  # after the load, of what it was before
MEMORY_SECONDS = 1.0
DOCUMENTED = {200, 202, 429, 503, 504}
SETTLE_SECONDS = 300.0


@dataclass
class Tally:
    """What was seen at one load."""

    answered: list[float] = field(default_factory=list)
    """Seconds of requests that were answered well."""
    ended: Counter[str] = field(default_factory=Counter)
    accepted: set[str] = field(default_factory=set)
    """Jobs."""
    live: list[float] = field(default_factory=list)
    memory: list[tuple[float, float]] = field(default_factory=list)
    """Seconds since the start, bytes of the service and its workers."""
    wrong: list[str] = field(default_factory=list)
    kills: Counter[str] = field(default_factory=Counter)


class Supervised:
    """The service as a supervisor runs it: started again whenever it ended."""

    def __init__(self, folder: Path, device: str) -> None:
        self.port = free_port()
        self.address = f"http://127.0.0.1:{self.port}"
        temporary = folder / "temporary"
        temporary.mkdir()
        values = {
            "port": self.port, "data_dir": folder / "data", "temp_dir": temporary, "device": device,
            "log_level": "error", "job_queue_size": 100,
        }  # fmt: skip
        self._environment = os.environ | {f"POINTFILTER_{name.upper()}": str(value) for name, value in values.items()}
        self._log = (folder / "service.log").open("ab")
        self.process = self._start()
        self.up_since = float("inf")

    def _start(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-m", "service"], env=self._environment, stderr=self._log)

    def workers(self) -> list[int]:
        found: list[int] = []
        for children in Path(f"/proc/{self.process.pid}/task").glob("*/children"):  # each thread has its own
            with contextlib.suppress(OSError):
                found += [int(text) for text in children.read_text().split() if _is_worker(int(text))]
        return found

    def memory(self) -> float:
        return sum(_resident(pid) for pid in [self.process.pid, *self.workers()])

    async def keep_up(self, client: httpx.AsyncClient) -> None:
        while True:
            if self.process.poll() is not None:
                self.up_since = float("inf")
                self.process = self._start()
            with contextlib.suppress(httpx.HTTPError):
                ready = (await client.get("/health/ready")).status_code == 200
                self.up_since = min(self.up_since, time.monotonic()) if ready else float("inf")
            await asyncio.sleep(0.2)

    @property
    def is_up(self) -> bool:
        return time.monotonic() > self.up_since

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait(60)
        self._log.close()


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.load", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="at each load")
    parser.add_argument("--factors", type=float, nargs="+", default=[1.0, 10.0], help="times the measured capacity")
    parser.add_argument("--kill-every", type=float, default=5.0, help="seconds between kills of a worker; 0: none")
    parser.add_argument("--kill-service-every", type=float, default=0.0, help="seconds between kills of the service")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path, help="write the figures there")
    options = parser.parse_args(arguments)
    rows = asyncio.run(_run(options))
    if options.json:
        options.json.write_text(json.dumps({"rows": rows}, indent=1) + "\n")
    return 1 if any(row["lost"] or row["wrong"] or row["not_met"] for row in rows) else 0


async def _run(options: argparse.Namespace) -> list[dict[str, Any]]:
    rows = []
    with tempfile.TemporaryDirectory(prefix="pointfilter-load-") as name:
        folder = Path(name)
        _, noisy = ring(POINTS).clouds(COLUMN)
        PointCloud(noisy).write(folder / "cloud.ply")
        body = (folder / "cloud.ply").read_bytes()
        service = Supervised(folder, options.device)
        try:
            limits = httpx.Limits(max_connections=None)
            async with httpx.AsyncClient(
                base_url=service.address, timeout=ANSWER_SECONDS, limits=limits, trust_env=False
            ) as client:
                keeper = asyncio.create_task(service.keep_up(client))
                while not service.is_up:
                    await asyncio.sleep(0.1)
                capacity, expected = await _capacity(client, body)
                print(f"capacity: {capacity:.2f} clouds of {POINTS} points a second, one after the other", flush=True)
                for factor in options.factors:
                    before = service.memory()
                    tally = await _load(client, service, body, expected, factor * capacity, options)
                    lost = await _settle(client, tally, expected)
                    row = _row(factor, capacity, tally, lost, options.seconds, before, service.memory())
                    rows.append(row)
                    print(_line(row), flush=True)
                keeper.cancel()
        finally:
            service.stop()
    return rows


async def _capacity(client: httpx.AsyncClient, body: bytes) -> tuple[float, str]:
    """Clouds a second one after the other, and the sha256 of the answer."""
    digests = set()
    started = time.perf_counter()
    count = 0
    while time.perf_counter() - started < 5 or count < 5:
        answer = await client.post("/filter", content=body)
        answer.raise_for_status()
        digests.add(hashlib.sha256(answer.content).hexdigest())
        count += 1
    (digest,) = digests
    return count / (time.perf_counter() - started), digest


async def _load(
    client: httpx.AsyncClient,
    service: Supervised,
    body: bytes,
    expected: str,
    rate: float,
    options: argparse.Namespace,
) -> Tally:
    tally = Tally()
    started = time.monotonic()
    watchers = [
        asyncio.create_task(_watch_live(client, service, tally)),
        asyncio.create_task(_watch_memory(service, tally, started)),
        asyncio.create_task(_kill(service, tally, options.kill_every, "worker")),
        asyncio.create_task(_kill(service, tally, options.kill_service_every, "service")),
    ]
    clients = set()
    generator = random.Random(0)
    async for _ in _arrivals(rate, options.seconds, generator):
        as_job, vanishes = generator.random() < JOBS, generator.random() < VANISHING
        clients.add(asyncio.create_task(_one(client, body, expected, as_job, vanishes, tally)))
    for watcher in watchers[2:]:
        watcher.cancel()
    await asyncio.gather(*clients)
    for watcher in watchers[:2]:
        watcher.cancel()
    await asyncio.gather(*watchers, return_exceptions=True)
    return tally


async def _arrivals(rate: float, seconds: float, generator: random.Random) -> AsyncIterator[None]:
    end = time.monotonic() + seconds
    due = time.monotonic()
    while (due := due + generator.expovariate(rate)) < end:
        await asyncio.sleep(max(0.0, due - time.monotonic()))
        yield


async def _one(
    client: httpx.AsyncClient, body: bytes, expected: str, as_job: bool, vanishes: bool, tally: Tally
) -> None:
    started = time.perf_counter()
    try:
        post = client.post("/jobs" if as_job else "/filter", content=body)
        answer = await (asyncio.wait_for(post, 0.2) if vanishes else post)
    except TimeoutError:
        tally.ended["vanished"] += 1
        return
    except httpx.TimeoutException:
        tally.wrong.append(f"no answer within {ANSWER_SECONDS:g} s")
        return
    except httpx.HTTPError as error:
        tally.ended[f"no answer ({type(error).__name__})"] += 1  # the service was killed
        return
    tally.ended[f"{'job ' if as_job else ''}{answer.status_code}"] += 1
    if answer.status_code not in DOCUMENTED:
        tally.wrong.append(f"status {answer.status_code}: {answer.text[:300]}")
    elif answer.status_code == 200:
        tally.answered.append(time.perf_counter() - started)
        if hashlib.sha256(answer.content).hexdigest() != expected:
            tally.wrong.append("an answer with other bytes")
    elif answer.status_code == 202:
        tally.accepted.add(answer.headers["location"])
    elif answer.status_code in (429, 503) and "retry-after" not in answer.headers and as_job:
        tally.wrong.append(f"status {answer.status_code} without Retry-After")


async def _settle(client: httpx.AsyncClient, tally: Tally, expected: str) -> int:
    """Waits for the jobs that were accepted, looks at their results and removes them. Returns how many were lost."""
    waiting = set(tally.accepted)
    end = time.monotonic() + SETTLE_SECONDS + len(waiting)
    while waiting and time.monotonic() < end:
        for location in list(waiting):
            with contextlib.suppress(httpx.HTTPError):
                answer = await client.get(location)
                if answer.status_code == 404:
                    tally.wrong.append(f"{location} is gone")
                    waiting.remove(location)
                    continue
                if answer.status_code != 200 or (state := answer.json()["state"]) in ("queued", "running"):
                    continue
                result = await client.get(f"{location}/result")
                if state != "done" or hashlib.sha256(result.content).hexdigest() != expected:
                    tally.wrong.append(f"{location} ended as {state}: {result.content[:200]!r}")
                await client.delete(location)
                waiting.remove(location)
        await asyncio.sleep(0.5)
    return len(waiting)


async def _watch_live(client: httpx.AsyncClient, service: Supervised, tally: Tally) -> None:
    while True:
        if service.is_up:
            started = time.perf_counter()
            try:
                status = (await client.get("/health/live", timeout=LIVE_TIMEOUT_SECONDS)).status_code
            except httpx.TimeoutException:
                tally.wrong.append(f"no /health/live within {LIVE_TIMEOUT_SECONDS:g} s")
            except httpx.HTTPError:
                tally.ended["live: no answer"] += 1  # the service was killed
            else:
                tally.live.append(time.perf_counter() - started)
                if status != 200:
                    tally.wrong.append(f"/health/live: {status}")
        await asyncio.sleep(LIVE_SECONDS)


async def _watch_memory(service: Supervised, tally: Tally, started: float) -> None:
    while True:
        tally.memory.append((time.monotonic() - started, service.memory()))
        await asyncio.sleep(MEMORY_SECONDS)


async def _kill(service: Supervised, tally: Tally, every: float, what: str) -> None:
    while every:
        await asyncio.sleep(every)
        victims = service.workers() if what == "worker" else [service.process.pid]
        if victims and service.is_up:
            with contextlib.suppress(ProcessLookupError):
                os.kill(random.choice(victims), signal.SIGKILL)
                tally.kills[what] += 1


def _row(
    factor: float, capacity: float, tally: Tally, lost: int, seconds: float, before: float, after: float
) -> dict[str, Any]:
    def percentiles(values: list[float]) -> dict[str, float]:
        return {f"p{p}": float(np.percentile(values, p)) if values else float("nan") for p in (50, 95, 99)}

    live = percentiles(tally.live)
    bars = {
        f"/health/live, p99 at most {1000 * LIVE_BAR:g} ms": live["p99"] <= LIVE_BAR,
        f"memory at most {MEMORY_BAR:g} of what it was": after <= MEMORY_BAR * before,
    }
    return {
        "not_met": [name for name, met in bars.items() if not met],
        "factor": factor,
        "capacity": capacity,
        "seconds": seconds,
        "answered": len(tally.answered),
        "jobs": len(tally.accepted),
        "throughput": (len(tally.answered) + len(tally.accepted)) / seconds,
        "latency": percentiles(tally.answered),
        "live": live,
        "ended": dict(tally.ended),
        "kills": dict(tally.kills),
        "lost": lost,
        "wrong": tally.wrong,
        "memory_mb": {
            "before": before / 1e6,
            "most": max((each for _, each in tally.memory), default=0.0) / 1e6,
            "after": after / 1e6,
        },
    }


def _line(row: dict[str, Any]) -> str:
    def times(values: dict[str, float]) -> str:
        return ", ".join(f"{name} {1000 * value:.0f} ms" for name, value in values.items())

    ended = ", ".join(f"{count} × {name}" for name, count in sorted(row["ended"].items()))
    kills = ", ".join(f"{count} × {name}" for name, count in row["kills"].items()) or "none"
    memory = ", ".join(f"{name} {value:.0f}" for name, value in row["memory_mb"].items())
    return (
        f"{row['factor']:g} × capacity for {row['seconds']:g} s: {row['throughput']:.2f} clouds a second\n"
        f"  answered {row['answered']} ({times(row['latency'])}); jobs accepted {row['jobs']}, lost {row['lost']}\n"
        f"  ended: {ended}\n  killed: {kills}\n  /health/live: {times(row['live'])}\n  memory, MB: {memory}\n"
        + "".join(f"  WRONG: {what}\n" for what in row["wrong"][:10])
        + "".join(f"  NOT MET: {what}\n" for what in row["not_met"])
    )


def _is_worker(pid: int) -> bool:
    with contextlib.suppress(OSError):
        return b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
    return False


def _resident(pid: int) -> float:
    with contextlib.suppress(OSError, ValueError, IndexError):
        return float(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0.0


if __name__ == "__main__":
    sys.exit(main())
