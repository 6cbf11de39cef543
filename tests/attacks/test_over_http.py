"""Hostile files and clients against a real service: documented answers, soon, in little memory."""

from __future__ import annotations

import http.client
import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from pointfilter.errors import InputError
from service.problem_types import TYPES
from tests.attacks.files import ATTACKS, GOOD, Attack
from tests.e2e.conftest import Server, running_service

SECONDS = 2.0
MEMORY = 300e6  # above idle, of the service and its workers together
LARGEST = 64 << 20  # larger ones are refused by the declared size alone
LORISES = 200


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Server, int]]:
    """The server and its process's number."""
    folder = tmp_path_factory.mktemp("service")
    limits = {"POINTFILTER_MAX_UPLOAD_BYTES": str(LARGEST), "POINTFILTER_MAX_POINTS": "2000000000"}
    with running_service(folder, **limits) as (server, process):
        server.post("/filter?radius=1", GOOD)  # both workers have been at work once
        yield server, process.pid


def resident(pid: int) -> float:
    """Bytes of a process and its children."""
    lists = Path(f"/proc/{pid}/task").glob("*/children")  # each thread has its own
    processes = [str(pid), *(number for children in lists for number in children.read_text().split())]
    assert len(processes) >= 3  # with two workers
    pages = sum(int(Path(f"/proc/{number}/statm").read_text().split()[1]) for number in processes)
    return pages * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture(scope="module")
def idle(service: tuple[Server, int]) -> float:
    return resident(service[1])


def status_of(error: type[InputError] | None) -> int:
    return 200 if error is None else TYPES[error.code].status


@pytest.mark.parametrize("attack", ATTACKS, ids=lambda attack: attack.name)
def test_a_hostile_file(attack: Attack, service: tuple[Server, int], idle: float, tmp_path: Path) -> None:
    server, pid = service
    path = tmp_path / "attack.ply"
    attack.write(path)
    if path.stat().st_size > LARGEST:
        pytest.skip("refused by its size alone: tests/service/test_refusals.py")
    body = path.read_bytes()
    started = time.perf_counter()
    answer = server.post("/filter", body)
    seconds = time.perf_counter() - started
    if body:
        assert answer.status == status_of(attack.error), answer.body[:300]
    else:
        assert answer.status == 400
    if answer.status != 200:
        problem = json.loads(answer.body)
        assert problem["type"] == f"/problems/{problem['code']}"
        assert str(tmp_path) not in answer.body.decode()
        assert "Traceback" not in answer.body.decode()
    assert seconds < SECONDS
    assert resident(pid) - idle < MEMORY


def test_clients_that_never_finish_do_not_keep_others_waiting(service: tuple[Server, int]) -> None:
    server, _ = service
    host, port = server.url.removeprefix("http://").split(":")
    with ExitStack() as stack:
        for number in range(LORISES):
            connection = stack.enter_context(socket.create_connection((host, int(port)), timeout=10))
            connection.sendall(b"GET / HTTP/1.1\r\nHost: a\r\nX-" + str(number).encode())
        for path, status in (("/health/live", 200), ("/health/ready", 200)):
            started = time.perf_counter()
            assert server.get(path).status == status
            assert time.perf_counter() - started < SECONDS
        assert server.post("/filter?radius=1", GOOD).status == 200


def test_a_million_tiny_parts(service: tuple[Server, int], idle: float) -> None:
    server, pid = service
    part = b'--b\r\nContent-Disposition: form-data; name="a"\r\n\r\n\r\n'
    body = part * (20_000_000 // len(part)) + b"--b--\r\n"
    host, port = server.url.removeprefix("http://").split(":")
    connection = http.client.HTTPConnection(host, int(port), timeout=30)
    started = time.perf_counter()
    connection.request("POST", "/filter", body, {"Content-Type": "multipart/form-data; boundary=b"})
    answer = connection.getresponse()
    assert answer.status == 400
    assert json.loads(answer.read())["code"] == "malformed-request"
    assert time.perf_counter() - started < SECONDS
    connection.close()
    assert resident(pid) - idle < MEMORY
