"""What is measured at export, of networks whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from export import calibration as module
from export.calibration import calibrate
from export.graph import build
from pointfilter.adaptive.calibration import Calibration
from pointfilter.metrics import point_to_surface
from pointfilter.network import Answers, Network
from training.network import NetworkSettings, Pointfilter
from training.own import UNCALIBRATED
from training.shapes import Mesh

GAIN = 0.15  # between two of module.MARGINS


def square() -> Mesh:
    """A flat surface: what draws points to their common plane does good there."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) / np.sqrt(2)
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.tile([0.0, 0.0, 1.0], (2, 3, 1)))


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CLOUDS", 3)
    monkeypatch.setattr(module, "POINTS", (400,))
    monkeypatch.setattr(module, "random_shape", lambda *_: square())


def telling(displacements: np.ndarray, log_still: float, gain: float) -> Answers:
    count = len(displacements)
    errors = np.tile(np.float32([log_still - gain, log_still]), (count, 1))
    return Answers(displacements.astype(np.float32), errors, np.tile(np.float32([0, 0, 1]), (count, 1)))


def flattening(patches: np.ndarray, _: np.ndarray, queries: np.ndarray, owners: np.ndarray) -> Answers:
    """Half the way to the plane through the middle of the patch."""
    moves = np.zeros_like(queries)
    moves[:, 2] = 0.5 * (patches[:, :, 2].mean(axis=1)[owners] - queries[:, 2])
    return telling(moves, -2.0, GAIN)


def harmful(patches: np.ndarray, context: np.ndarray, queries: np.ndarray, owners: np.ndarray) -> Answers:
    said = flattening(patches, context, queries, owners)
    return said._replace(displacements=-said.displacements)


def staying(_patches: np.ndarray, _context: np.ndarray, queries: np.ndarray, _owners: np.ndarray) -> Answers:
    return telling(np.zeros_like(queries), -2.0, -GAIN)


def of(network: Network, monkeypatch: pytest.MonkeyPatch) -> Calibration:
    with monkeypatch.context() as patch:
        patch.setattr(module, "graph_network", lambda _: network)
        return calibrate(b"", patch_points=32)


def test_a_small_network_is_calibrated_the_same_every_time() -> None:
    torch.manual_seed(0)
    network = Pointfilter(NetworkSettings((8, 16), (8,), adaptive=True)).eval()
    with torch.no_grad():
        network.head.bias[3:5] = torch.tensor([-2.0, -1.0])  # expects to help
    serialised = build(network).SerializeToString()
    found = calibrate(serialised, patch_points=32)
    assert found == calibrate(serialised, patch_points=32)
    assert found == Calibration.from_dict(found.as_dict())
    assert (found.balls, found.passes) == (UNCALIBRATED.balls, UNCALIBRATED.passes)
    assert found.preference in module.PREFERENCES
    assert found.still_weight in module.STILL_WEIGHTS
    assert found.margin in module.MARGINS
    assert found.error_factor not in (0.0, 1.0)


def test_the_margin_is_the_largest_that_costs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert of(flattening, monkeypatch).margin == max(margin for margin in module.MARGINS if margin < GAIN)
    assert of(harmful, monkeypatch).margin == max(module.MARGINS)


def test_the_preference_is_that_of_the_least_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """A network that helps in large balls alone, and one that helps in small ones alone, by the points in the ball."""

    def helping(large: bool) -> Network:
        def ask(patches: np.ndarray, context: np.ndarray, queries: np.ndarray, owners: np.ndarray) -> Answers:
            said = flattening(patches, context, queries, owners)
            is_large = (context[:, 0] > np.log2(100) / 6 - 1)[owners]
            return said._replace(displacements=np.where((is_large == large)[:, None], 1, -1) * said.displacements)

        return ask

    monkeypatch.setattr(module, "STILL_WEIGHTS", (1.0,))  # other weights prefer small balls by themselves
    large, small = (of(helping(large), monkeypatch).preference for large in (True, False))
    assert large < small


def test_the_error_factor_makes_expected_errors_real_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    found = of(flattening, monkeypatch)
    ratios = []
    for number in range(3):
        cloud = module._cloud(number, module.LEVELS[number])
        left, expected = module._measured(cloud, flattening, found, 32)
        ratios.append(left.mean() / expected.mean())
    assert found.error_factor != 1
    assert np.exp(np.mean(np.log(ratios))) == pytest.approx(1, rel=1e-6)


def test_the_factor_of_a_network_that_moves_nothing_is_that_of_the_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    found = of(staying, monkeypatch)
    cloud = module._cloud(0, module.LEVELS[0])
    left, expected = module._measured(cloud, staying, found, 32)
    before = point_to_surface(cloud.noisy[: len(left)], cloud.mesh.vertices, cloud.mesh.faces)
    np.testing.assert_array_equal(left, before)
    assert np.isfinite(expected).all()
    assert found.error_factor != 1


def test_a_cloud_is_a_piece_as_dense_as_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is measured lies in the middle of the piece, where the border is far away."""
    monkeypatch.setattr(module, "PIECE_POINTS", 100)
    monkeypatch.setattr(module, "POINTS", (400, 40_000))
    for number, share in ((0, 100 / 400), (len(module.LEVELS), 100 / 40_000)):
        cloud = module._cloud(number, 0.0)
        distances = np.linalg.norm(cloud.noisy - cloud.noisy[0], axis=1)
        assert (np.diff(distances) >= 0).all()
        assert len(distances) == 100
        area = share * 0.5  # of the square
        assert (
            np.sqrt(area / np.pi) * 0.9 < distances[-1] < 2 * np.sqrt(area / np.pi) * 1.1
        )  # a disc, or cut by a corner
