"""The image and the compose file, built and run for real. Skips, with the reason, where there is no container engine.

Slow on a first run: the image is built without a cache. POINTFILTER_TEST_PYTHON_IMAGE names another base image.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e.conftest import NOISY, ROOT, Server, free_port

pytestmark = pytest.mark.timeout(900)

IMAGE = "pointfilter:latest"
NOTICES = "/usr/share/doc/pointfilter"
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


def test_the_alert_rules_are_loaded(stack: tuple[Server, Server, str]) -> None:
    _, prometheus, _ = stack
    groups = prometheus.get("/api/v1/rules").json()["data"]["groups"]  # type: ignore[index]
    loaded = {rule["name"]: rule["health"] for group in groups for rule in group["rules"]}
    assert "PointfilterDown" in loaded
    assert "err" not in loaded.values()


def test_it_comes_back_after_a_stop(stack: tuple[Server, Server, str]) -> None:
    server, _, container = stack
    run("docker", "exec", container, "python3", "-c", "import os, signal; os.kill(1, signal.SIGTERM)")
    time.sleep(1)
    server.wait_until_ready(90)


def test_a_kill_loses_no_job(stack: tuple[Server, Server, str]) -> None:
    server, _, container = stack
    body = NOISY.read_bytes()
    jobs = [str(server.post("/jobs?iterations=1", body).json()["href"]) for _ in range(3)]
    (described,) = json.loads(run("docker", "inspect", container))
    try:
        os.kill(described["State"]["Pid"], signal.SIGKILL)  # the engine must not think that somebody wanted it stopped
    except (PermissionError, ProcessLookupError):
        pytest.skip("the container's processes are not this user's to kill")
    time.sleep(1)
    server.wait_until_ready(90)
    for job in jobs:
        while (state := server.get(f"{job}?wait=60").json()["state"]) in ("queued", "running"):
            pass
        assert state == "done"
    results = {server.get(f"{job}/result").body for job in jobs}
    assert results == {server.post("/filter?iterations=1", body).body}


def test_a_killed_worker_is_replaced(stack: tuple[Server, Server, str]) -> None:
    server, _, container = stack
    script = (
        "import os, pathlib, signal\n"
        "killed = 0\n"
        "for path in pathlib.Path('/proc').glob('[0-9]*/cmdline'):\n"
        "    if path.parent.name != str(os.getpid()) and b'spawn_main' in path.read_bytes():\n"
        "        os.kill(int(path.parent.name), signal.SIGKILL)\n"
        "        killed += 1\n"
        "assert killed == 2, killed"
    )
    run("docker", "exec", container, "python3", "-c", script)
    assert server.post("/filter?iterations=1", NOISY.read_bytes()).status == 200
    assert server.get("/health/live").status == 200


def test_the_image_is_not_large(image: str, capsys: pytest.CaptureFixture[str]) -> None:
    base = os.environ.get("POINTFILTER_TEST_PYTHON_IMAGE", "python:3.11-slim")
    size, under = (int(run("docker", "image", "inspect", "--format", "{{.Size}}", name)) for name in (image, base))
    with capsys.disabled():
        print(f"\nimage: {size / 1e6:.0f} MB, {(size - under) / 1e6:.0f} MB above its base")
    assert size - under <= 550e6


def test_the_image_lists_its_parts_and_their_licences(image: str) -> None:
    listed = json.loads(run("docker", "run", "--rm", "--network", "none", image, "cat", f"{NOTICES}/sbom.json"))
    assert listed["bomFormat"] == "CycloneDX"
    licences = {part["name"]: part.get("licenses") for part in listed["components"]}
    assert {"plyfile", "numpy", "onnxruntime", "fastapi", "huey"} <= licences.keys()
    assert all(licences[name] for name in ("plyfile", "numpy", "fastapi"))
    assert "plyfile" in run("docker", "run", "--rm", "--network", "none", image, "cat", f"{NOTICES}/NOTICE")


@pytest.mark.parametrize("overlay", ["compose.gpu.yaml", "compose.replicas.yaml"])
def test_the_overlays_fit(overlay: str) -> None:
    compose = compose_command()
    if compose is None:
        pytest.skip("no docker compose on this machine")
    profiles = ["--profile", "dashboard"]
    merged = json.loads(run(*compose, "-f", "compose.yaml", "-f", overlay, *profiles, "config", "--format", "json"))
    for name, service in merged["services"].items():
        assert service["read_only"], name
        assert service["cap_drop"] == ["ALL"], name
        assert service["mem_limit"], name
        for port in service.get("ports", []):
            assert port["host_ip"] == "127.0.0.1", name
    assert ("ports" in merged["services"]["pointfilter"]) is (overlay == "compose.gpu.yaml")


def test_the_dockerfile_follows_the_rules() -> None:
    if not shutil.which("hadolint"):
        pytest.skip("no hadolint on this machine")
    run("hadolint", "docker/Dockerfile")
