"""The README's promise on a live server: a noisy scan in, a clean one out, everything else as it was."""

from __future__ import annotations

import signal
import threading
from pathlib import Path

import numpy as np
import plyfile
import pytest

from pointfilter import PointCloud
from pointfilter.evaluation import evaluate
from pointfilter.models import DEFAULT_MODEL
from pointfilter.noise import add_noise
from tests.e2e.conftest import CLEAN, MESH, NOISY, Answer, Server, running_service


def test_the_example_comes_back_clean(service: Server, tmp_path: Path) -> None:
    answer = service.post("/filter?iterations=2", NOISY.read_bytes())
    assert answer.status == 200, answer.body
    assert answer.headers["x-model"] == DEFAULT_MODEL
    assert int(answer.headers["x-iterations"]) <= 2
    assert 0 < int(answer.headers["x-moved"]) <= int(answer.headers["x-points"])
    assert 0 < float(answer.headers["x-expected-error"]) < float(answer.headers["x-radius"])
    result = tmp_path / "clean.ply"
    result.write_bytes(answer.body)

    before, after = plyfile.PlyData.read(NOISY), plyfile.PlyData.read(result)
    assert after["vertex"].data.dtype == before["vertex"].data.dtype
    for name in ("red", "green", "blue", "scalar_intensity"):
        np.testing.assert_array_equal(after["vertex"][name], before["vertex"][name])
    assert after.comments[: len(before.comments)] == before.comments
    assert len(after.comments) == len(before.comments) + 1

    clean = PointCloud.read(CLEAN)
    for mesh in (MESH, None):
        noisy_scores = evaluate(PointCloud.read(NOISY), clean, mesh)
        scores = evaluate(PointCloud.read(result), clean, mesh)
        for name in scores:
            if name.startswith(("CD", "P2F")):
                assert scores[name] < noisy_scores[name] / 3, (name, noisy_scores[name], scores[name])


def test_the_same_request_gives_the_same_bytes(service: Server) -> None:
    body = NOISY.read_bytes()
    first, second = (service.post("/filter?iterations=1&seed=3", body) for _ in range(2))
    assert first.status == 200
    assert first.body == second.body


def test_a_hundred_thousand_points_are_answered(service: Server) -> None:
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(100_000, 3))
    sphere = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    noisy = add_noise(sphere, 0.005, rng).astype("<f4")
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 100000\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    answer = service.post("/filter?iterations=1", header.encode() + noisy.tobytes())
    assert answer.status == 200, answer.body[:500]
    filtered = np.frombuffer(answer.body, "<f4", offset=len(answer.body) - noisy.nbytes).reshape(-1, 3)
    error_before = np.abs(np.linalg.norm(noisy, axis=1) - 1).mean()
    error_after = np.abs(np.linalg.norm(filtered, axis=1) - 1).mean()
    assert error_after < error_before / 2


@pytest.mark.parametrize("path", ["/health", "/health/live", "/health/ready", "/health/startup", "/models", "/version"])
def test_the_small_routes_answer(service: Server, path: str) -> None:
    assert service.get(path).status == 200


def test_sigterm_lets_the_running_request_finish(tmp_path: Path) -> None:
    answers: list[Answer] = []
    with running_service(tmp_path, POINTFILTER_DRAIN_SECONDS="200") as (server, process):
        request = threading.Thread(target=lambda: answers.append(server.post("/filter", NOISY.read_bytes())))
        request.start()
        for _ in range(200):
            if b"pointfilter_in_progress 1.0" in server.get("/metrics").body:
                break
        process.send_signal(signal.SIGTERM)
        request.join(120)
        assert process.wait(60) == 0
    assert [answer.status for answer in answers] == [200]
