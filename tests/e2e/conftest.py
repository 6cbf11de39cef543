"""Real processes: a live uvicorn, the built wheel in an empty environment, the container."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NOISY = ROOT / "examples" / "bracket_noisy.ply"
CLEAN = ROOT / "examples" / "bracket_clean.ply"
MESH = ROOT / "examples" / "bracket_mesh.ply"


@dataclass(frozen=True)
class Answer:
    status: int
    headers: dict[str, str]
    body: bytes

    def json(self) -> dict[str, object]:
        parsed: dict[str, object] = json.loads(self.body)
        return parsed


@dataclass(frozen=True)
class Server:
    """A service on the loopback interface."""

    url: str

    def get(self, path: str) -> Answer:
        return self._send(urllib.request.Request(self.url + path))

    def post(self, path: str, body: bytes) -> Answer:
        headers = {"Content-Type": "application/octet-stream"}
        return self._send(urllib.request.Request(self.url + path, data=body, headers=headers))

    def _send(self, request: urllib.request.Request) -> Answer:
        try:
            with urllib.request.urlopen(request, timeout=240) as response:
                return Answer(response.status, dict(response.headers), response.read())
        except urllib.error.HTTPError as error:
            with error:
                return Answer(error.code, dict(error.headers), error.read())

    def wait_until_ready(self, seconds: float = 60) -> None:
        deadline = time.monotonic() + seconds
        while True:
            try:
                if self.get("/health/ready").status == 200:
                    return
            except OSError:
                pass
            if time.monotonic() > deadline:
                pytest.fail(f"the service at {self.url} was not ready after {seconds} s")
            time.sleep(0.2)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@contextmanager
def running_service(folder: Path, **settings: str) -> Iterator[tuple[Server, subprocess.Popen[bytes]]]:
    """`python -m service` as a user starts it; its log goes to a file that a failing test shows."""
    port = free_port()
    ours = {"POINTFILTER_PORT": str(port), "POINTFILTER_DATA_DIR": str(folder / "data"), "ORT_DISABLE_TELEMETRY": "1"}
    environment = os.environ | ours | settings
    with (folder / "service.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "service"], cwd=ROOT, env=environment, stdout=log, stderr=subprocess.STDOUT
        )
        try:
            server = Server(f"http://127.0.0.1:{port}")
            server.wait_until_ready()
            yield server, process
        finally:
            process.terminate()
            process.wait(60)
            print((folder / "service.log").read_text()[-4000:])


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with running_service(tmp_path_factory.mktemp("service")) as (server, _):
        yield server
