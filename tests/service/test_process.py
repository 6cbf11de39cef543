"""The real thing: `python -m service` as a process, spoken to over the loopback interface."""

from __future__ import annotations

import hashlib
import http.client
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from pointfilter import PointCloud
from tests.e2e.conftest import free_port
from tests.service.apps import until

ROOT = Path(__file__).parents[2]


@dataclass
class Running:
    process: subprocess.Popen[bytes]
    log: Path
    port: int = 0

    def lines(self) -> list[dict[str, object]]:
        return [json.loads(line) for line in self.log.read_text(encoding="utf-8").splitlines()]

    def codes(self) -> list[object]:
        return [line.get("code") for line in self.lines() if line["message"] == "request" and line["method"] == "POST"]

    def get(self, path: str) -> tuple[int, bytes]:
        return self.send("GET", path)

    def post(self, body: object, query: str = "") -> tuple[int, bytes]:
        return self.send("POST", f"/filter{query}", body)

    def send(self, method: str, path: str, body: object = None) -> tuple[int, bytes]:
        request = urllib.request.Request(f"http://127.0.0.1:{self.port}{path}", data=body, method=method)  # type: ignore[arg-type]
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                return answer.status, answer.read()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.read()

    def memory(self) -> int:
        """Resident bytes now."""
        status = Path(f"/proc/{self.process.pid}/status").read_text(encoding="utf-8")
        found = re.search(r"VmRSS:\s+(\d+) kB", status)
        assert found
        return 1024 * int(found[1])


@contextmanager
def process(bundles: Path, folder: Path, **settings: object) -> Iterator[Running]:
    """A process that has logged its first lines; killed at the end if it still runs."""
    data = folder.parent / "data"
    values = {"port": 0, "model_dir": bundles, "model": "tiny", "temp_dir": folder, "data_dir": data, "threads": 1}
    values |= settings
    environment = {name: value for name, value in os.environ.items() if not name.startswith("POINTFILTER_")}
    environment |= {f"POINTFILTER_{name.upper()}": str(value) for name, value in values.items()}
    log = folder.parent / "service.log"
    with log.open("wb") as file:
        child = subprocess.Popen([sys.executable, "-m", "service"], cwd=ROOT, env=environment, stderr=file)
    try:
        yield Running(child, log)
    finally:
        if child.poll() is None:
            child.kill()
        child.wait(10)


def is_listening(found: Running) -> bool:
    assert found.process.poll() is None, found.log.read_text(encoding="utf-8")
    port = re.search(r"http://127\.0\.0\.1:(\d+)", found.log.read_text(encoding="utf-8"))
    found.port = int(port[1]) if port else 0
    return port is not None and found.get("/health/ready")[0] == 200


@pytest.fixture
def running(bundles: Path, temp_dir: Path) -> Iterator[Callable[..., Running]]:
    """Starts a ready process."""
    with ExitStack() as stack:

        def start(**settings: object) -> Running:
            found = stack.enter_context(process(bundles, temp_dir, **settings))

            until(partial(is_listening, found), 60)
            return found

        yield start


@pytest.fixture(scope="module")
def long_work(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A cloud that takes minutes with ten iterations, in batches of a fraction of a second."""
    path = tmp_path_factory.mktemp("long") / "long.ply"
    points = np.random.default_rng(0).uniform(size=(60_000, 3))
    PointCloud(points).write(path)
    return path.read_bytes()


def begin(running: Running, body: bytes, query: str = "") -> socket.socket:
    """A request that was sent whole and not answered yet."""
    connection = socket.create_connection(("127.0.0.1", running.port), timeout=60)
    head = f"POST /filter{query} HTTP/1.1\r\nHost: here\r\nContent-Length: {len(body)}\r\n\r\n"
    connection.sendall(head.encode() + body)
    return connection


def job_states(running: Running, jobs: list[str]) -> list[str]:
    return [json.loads(running.get(f"/jobs/{job}")[1])["state"] for job in jobs]


def test_a_killed_service_loses_no_job(
    bundles: Path, temp_dir: Path, running: Callable[..., Running], long_work: bytes, ply: bytes
) -> None:
    query = "?iterations=4&radius=0.03"
    first = running()
    jobs = []
    for body in (long_work, ply, long_work, ply):
        status, answer = first.send("POST", f"/jobs{query}", body)
        assert status == 202
        jobs.append(json.loads(answer)["id"])
    until(lambda: "running" in job_states(first, jobs))
    first.process.kill()
    first.process.wait(10)
    second = running()
    until(lambda: job_states(second, jobs) == ["done"] * 4, 120)
    results = [second.get(f"/jobs/{job}/result") for job in jobs]
    expected = [second.post(body, query)[1] for body in (long_work, ply)]
    assert results == [(200, expected[0]), (200, expected[1])] * 2


def test_replicas_share_the_jobs_through_redis(
    bundles: Path, temp_dir: Path, tmp_path: Path, long_work: bytes, ply: bytes
) -> None:
    if not shutil.which("redis-server"):
        pytest.skip("no redis-server on this machine (Debian: apt-get install redis-server)")
    port = free_port()
    command = ["redis-server", "--port", str(port), "--save", "", "--dir", str(tmp_path)]
    redis = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        with ExitStack() as stack:
            replicas = []
            for number in range(2):
                folder = tmp_path / f"replica{number}" / "temporary"
                folder.mkdir(parents=True)
                settings = {"redis_url": f"redis://127.0.0.1:{port}/0", "data_dir": tmp_path / "shared"}
                replicas.append(stack.enter_context(process(bundles, folder, **settings)))
            for replica in replicas:
                until(partial(is_listening, replica), 60)
            one, two = replicas
            query = "?iterations=4&radius=0.03"
            jobs = [json.loads(one.send("POST", f"/jobs{query}", body)[1])["id"] for body in (long_work, ply) * 3]
            until(lambda: job_states(two, jobs).count("running") >= 2, 30)
            one.process.kill()
            until(lambda: job_states(two, jobs) == ["done"] * 6, 120)
            assert {two.get(f"/jobs/{job}/result")[1] for job in jobs[1::2]} == {two.post(ply, query)[1]}
    finally:
        redis.terminate()
        redis.wait(10)


def test_a_small_job_is_not_behind_a_large_one(running: Callable[..., Running], long_work: bytes, ply: bytes) -> None:
    service = running()
    large = json.loads(service.send("POST", "/jobs?iterations=10&radius=0.2", long_work)[1])["id"]
    until(lambda: job_states(service, [large]) == ["running"])
    started = time.monotonic()
    small = json.loads(service.send("POST", "/jobs", ply)[1])["id"]
    assert json.loads(service.get(f"/jobs/{small}?wait=20")[1])["state"] == "done"
    assert time.monotonic() - started < 5
    assert job_states(service, [large]) == ["running"]
    started = time.monotonic()
    assert service.send("DELETE", f"/jobs/{large}")[0] == 204
    assert time.monotonic() - started < 3
    assert job_states(service, [large]) == ["cancelled"]


def test_keys_are_made_by_a_command() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "service", "key", "ann"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    name, digest = done.stdout.split()
    key = done.stderr.split()[-1]
    assert (name, digest) == ("ann", hashlib.sha256(key.encode()).hexdigest())
    for arguments in (["key"], ["key", "a b"], ["kay", "ann"]):
        done = subprocess.run([sys.executable, "-m", "service", *arguments], cwd=ROOT, capture_output=True, check=False)
        assert done.returncode == 2
        assert done.stderr


def in_progress(running: Running) -> object:
    return json.loads(running.get("/health")[1])["in_progress"]


def test_a_disconnect_stops_the_work(running: Callable[..., Running], long_work: bytes, temp_dir: Path) -> None:
    service = running()
    connection = begin(service, long_work, "?iterations=10&radius=0.2")
    until(lambda: in_progress(service) == 1)
    connection.close()
    until(lambda: in_progress(service) == 0)
    until(lambda: service.codes() == ["client-closed"])
    assert list(temp_dir.iterdir()) == []


def test_the_deadline_stops_the_work(running: Callable[..., Running], long_work: bytes, temp_dir: Path) -> None:
    service = running(timeout_seconds=1)
    started = time.monotonic()
    status, body = service.post(long_work, "?iterations=10&radius=0.2")
    assert (status, json.loads(body)["code"]) == (504, "deadline-exceeded")
    assert time.monotonic() - started < 20
    assert in_progress(service) == 0
    assert list(temp_dir.iterdir()) == []


def test_a_stop_lets_a_running_request_finish(
    running: Callable[..., Running], long_work: bytes, temp_dir: Path
) -> None:
    service = running(drain_seconds=120)
    connection = begin(service, long_work, "?iterations=8&radius=0.03")
    until(lambda: in_progress(service) == 1)
    service.process.send_signal(signal.SIGTERM)
    answer = http.client.HTTPResponse(connection)
    answer.begin()
    assert answer.status == 200
    assert len(answer.read()) > len(long_work)
    connection.close()
    assert service.process.wait(30) == 0
    assert list(temp_dir.iterdir()) == []


def test_a_stop_does_not_wait_for_ever(running: Callable[..., Running], long_work: bytes, temp_dir: Path) -> None:
    service = running(drain_seconds=1)
    connection = begin(service, long_work, "?iterations=10&radius=0.2")
    until(lambda: in_progress(service) == 1)
    started = time.monotonic()
    service.process.send_signal(signal.SIGTERM)
    assert service.process.wait(30) == 0
    assert time.monotonic() - started < 20
    answer = http.client.HTTPResponse(connection)
    answer.begin()
    assert (answer.status, json.loads(answer.read())["code"]) == (503, "draining")
    answer.close()
    connection.close()
    assert list(temp_dir.iterdir()) == []


def test_an_oversize_client_that_sends_before_it_listens_sees_the_answer(running: Callable[..., Running]) -> None:
    service = running(max_upload_bytes=100_000)
    for body in (bytes(20_000_000), (bytes(65_536) for _ in range(300))):  # declared, then in chunks
        status, answer = service.post(body)
        assert (status, json.loads(answer)["code"]) == (413, "limit-exceeded")


def test_memory_does_not_follow_the_upload(running: Callable[..., Running]) -> None:
    service = running()
    assert service.post(bytes(1000))[0] == 415
    before = service.memory()
    most = 0

    def chunks() -> Iterator[bytes]:
        nonlocal most
        for _ in range(1600):
            yield bytes(65_536)
            most = max(most, service.memory())

    status, _ = service.post(chunks())
    assert status == 415
    assert most - before < 30_000_000


def test_files_are_private_while_they_are_there(
    running: Callable[..., Running], long_work: bytes, temp_dir: Path
) -> None:
    service = running()
    connection = begin(service, long_work, "?iterations=10&radius=0.2")
    until(lambda: in_progress(service) == 1)
    (folder,) = temp_dir.iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700
    (upload,) = folder.iterdir()
    assert upload.stat().st_mode & 0o777 == 0o600
    connection.close()
    until(lambda: not list(temp_dir.iterdir()))


def test_one_connection_serves_many_requests(running: Callable[..., Running]) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", running(max_upload_bytes=1000).port, timeout=60)
    for method, path, body, status in [
        ("HEAD", "/health/live", None, 200),
        ("GET", "/nothing", None, 404),
        ("POST", "/filter", bytes(2000), 413),
        ("POST", "/nothing", bytes(2000), 404),
        ("HEAD", "/filter", None, 405),
        ("GET", "/version", None, 200),
    ]:
        connection.request(method, path, body)
        answer = connection.getresponse()
        content = answer.read()
        assert answer.status == status
        assert bool(content) is (method != "HEAD")
    connection.close()


@pytest.mark.parametrize(
    ("settings", "code", "told"),
    [
        ({"model": "nobody"}, 1, "no model"),
        ({"model": "broken"}, 1, "sha256"),
        ({"device": "cuda"}, 1, "CUDAExecutionProvider"),
        ({"port": "high"}, 2, "POINTFILTER_PORT"),
    ],
)
def test_a_start_that_fails_says_why(
    bundles: Path, temp_dir: Path, settings: dict[str, object], code: int, told: str
) -> None:
    with process(bundles, temp_dir, **settings) as service:
        assert service.process.wait(60) == code
        assert told in service.log.read_text(encoding="utf-8")


def test_a_port_that_is_taken_is_an_error(bundles: Path, temp_dir: Path) -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as taken,
        process(bundles, temp_dir, port=taken.getsockname()[1]) as service,
    ):
        assert service.process.wait(60) == 3
        assert "address already in use" in service.log.read_text(encoding="utf-8")
