"""The image and the compose file, built and run for real. Skips, with the reason, where there is no container engine.

Slow on a first run: the image is built without a cache. POINTFILTER_TEST_PYTHON_IMAGE names another base image.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e.conftest import NOISY, ROOT, Server, free_port

pytestmark = pytest.mark.timeout(900)

IMAGE = "pointfilter:latest"
PROJECT = f"pointfilter-test-{os.getpid()}"


def run(*command: str | Path, **environment: str) -> str:
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | environment, capture_output=True, text=True, check=False, timeout=850
    )
    assert done.returncode == 0, f"{command}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    return done.stdout


def compose_command() -> list[str] | None:
    """`docker compose` or `docker-compose`, whichever works here."""
    for command in (["docker", "compose"], ["docker-compose"]):
        if shutil.which(command[0]):
            done = subprocess.run([*command, "version"], capture_output=True, check=False)
            if done.returncode == 0:
                return command
    return None


@pytest.fixture(scope="module")
def image() -> str:
    if not shutil.which("docker"):
        pytest.skip("no docker command on this machine")
    if subprocess.run(["docker", "info"], capture_output=True, check=False).returncode != 0:
        pytest.skip("no container engine answers")
    base = os.environ.get("POINTFILTER_TEST_PYTHON_IMAGE", "python:3.11-slim")
    arguments = ["--build-arg", f"PYTHON_IMAGE={base}", "-t", IMAGE, "-f", "docker/Dockerfile", "."]
    run("docker", "build", "--network", os.environ.get("BUILD_NETWORK", "host"), *arguments)
    return IMAGE


@pytest.fixture(scope="module")
def stack(image: str) -> Iterator[tuple[Server, Server, str]]:
    """The service and Prometheus, up and healthy; taken down whatever happens."""
    compose = compose_command()
    if compose is None:
        pytest.skip("no docker compose on this machine")
    ports = {"PORT": str(free_port()), "PROMETHEUS_PORT": str(free_port())}
    command = [*compose, "--project-name", PROJECT, "--profile", "monitoring"]
    try:
        run(*command, "up", "--detach", "--no-build", "--pull", "never", "--wait", **ports)
        container = run(*command, "ps", "--quiet", "pointfilter", **ports).strip()
        yield (
            Server(f"http://127.0.0.1:{ports['PORT']}"),
            Server(f"http://127.0.0.1:{ports['PROMETHEUS_PORT']}"),
            container,
        )
    finally:
        subprocess.run(
            [*command, "down", "--volumes", "--timeout", "40"],
            cwd=ROOT,
            env=os.environ | ports,
            check=True,
            timeout=120,
        )


def test_the_image_has_no_torch_and_no_compiler(image: str) -> None:
    script = "import importlib.util as u, shutil, sys; sys.exit(bool(u.find_spec('torch') or shutil.which('g++')))"
    run("docker", "run", "--rm", "--network", "none", image, "python3", "-c", script)


def test_the_image_needs_no_network_and_no_writable_root(image: str) -> None:
    flags = ["--rm", "--network", "none", "--read-only", "--tmpfs", "/tmp", "--cap-drop", "ALL"]  # noqa: S108
    checked = json.loads(run("docker", "run", *flags, image, "pointfilter", "doctor", "--json"))
    assert checked["provider"] == "CPUExecutionProvider"


def test_a_scan_goes_through_the_stack(stack: tuple[Server, Server, str]) -> None:
    server, _, _ = stack
    answer = server.post("/filter?iterations=1", NOISY.read_bytes())
    assert answer.status == 200, answer.body[:500]
    assert len(answer.body) > NOISY.stat().st_size


def test_it_runs_as_nobody_in_particular(stack: tuple[Server, Server, str]) -> None:
    _, _, container = stack
    (described,) = json.loads(run("docker", "inspect", container))
    assert described["Config"]["User"] == "10001:10001"
    host = described["HostConfig"]
    assert host["ReadonlyRootfs"] is True
    assert host["CapDrop"] == ["ALL"]
    assert host["Memory"] > 0
    assert host["PidsLimit"] > 0
    assert described["State"]["Health"]["Status"] == "healthy"
    done = subprocess.run(["docker", "exec", container, "touch", "/app/x"], capture_output=True, check=False)
    assert done.returncode != 0


def test_prometheus_scrapes_it(stack: tuple[Server, Server, str]) -> None:
    _, prometheus, _ = stack
    for _ in range(60):
        answer = prometheus.get("/api/v1/query?query=pointfilter_model_info").json()
        if answer["data"]["result"]:  # type: ignore[index]
            return
        time.sleep(1)
    pytest.fail("Prometheus never saw pointfilter_model_info")


def test_it_comes_back_after_a_kill(stack: tuple[Server, Server, str]) -> None:
    server, _, container = stack
    run("docker", "exec", container, "python3", "-c", "import os, signal; os.kill(1, signal.SIGTERM)")
    time.sleep(1)
    server.wait_until_ready(90)
