from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from training.losses import (
    FLOOR,
    LossName,
    LossSettings,
    adaptive_loss,
    expectation_loss,
    filtering_loss,
    surface_distances,
)
from training.network import Answers

PAPERS: tuple[LossName, ...] = ("bilateral", "projection", "l2")


def naive(p: np.ndarray, clean: np.ndarray, normals: np.ndarray, settings: LossSettings) -> float:
    """Eq. 3 to 7 for one patch, point by point."""
    if len(clean) == 0:
        return 0.0
    lengths = [math.dist(p, q) for q in clean]
    nearest = int(np.argmin(lengths))
    diagonal = math.dist(clean.max(axis=0), clean.min(axis=0))
    sigma_p = settings.sigma_p or 4 * math.sqrt(diagonal / settings.sigma_p_points)
    above = below = 0.0
    for q, n, d in zip(clean, normals, lengths, strict=True):
        weight = math.exp(-(d**2) / sigma_p**2)
        if settings.loss == "bilateral":
            exponent = (1 - normals[nearest] @ n) / (1 - math.cos(math.radians(settings.sigma_n_degrees)))
            weight *= math.exp(-(exponent**2 if settings.theta_squared else exponent))
        above += abs((p - q) @ n) * weight
        below += weight
    main = lengths[nearest] ** 2 if settings.loss == "l2" else above / below
    loss = settings.eta * main + (1 - settings.eta) * max(lengths)
    along = p - (p @ normals[nearest]) * normals[nearest]
    return float(loss + settings.tangential_weight * np.linalg.norm(along))


def patches(seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    answers = 0.2 * torch.randn(5, 3, generator=generator, dtype=torch.float64)
    clean = torch.rand(5, 30, 3, generator=generator, dtype=torch.float64) * 2 - 1
    normals = torch.randn(5, 30, 3, generator=generator, dtype=torch.float64)
    normals[..., 2] += 3
    normals /= normals.norm(dim=2, keepdim=True)
    present = torch.arange(30) < torch.tensor([30, 17, 3, 1, 0])[:, None]
    clean[~present], normals[~present] = 0, 0
    return answers, clean, normals, present


def test_the_support_shrinks_with_the_run() -> None:
    answers, clean, normals, present = patches(3)
    shrinking = LossSettings(loss="bilateral", sigma_p=0.4, sigma_p_shrink=0.25)
    for progress, sigma_p in ((0.0, 0.4), (0.5, 0.2), (1.0, 0.1)):
        found = filtering_loss(answers, clean, normals, present, shrinking, progress)
        fixed = filtering_loss(answers, clean, normals, present, LossSettings(loss="bilateral", sigma_p=sigma_p))
        torch.testing.assert_close(found, fixed)


@pytest.mark.parametrize("loss", PAPERS)
@pytest.mark.parametrize(
    "flags",
    [
        {},
        {"eta": 0.5},
        {"eta": 1.0},
        {"sigma_p": 0.3},
        {"sigma_p_points": 50},
        {"sigma_n_degrees": 40.0},
        {"theta_squared": True},
        {"tangential_weight": 0.0},
    ],
    ids=str,
)
def test_losses_are_what_the_equations_say(loss: str, flags: dict[str, object]) -> None:
    settings = LossSettings(loss=loss, **flags)
    answers, clean, normals, present = patches(3)
    found = filtering_loss(answers, clean, normals, present, settings)
    assert torch.isfinite(found).all()
    assert found[-1] == 0
    for row in (
        (0, 1, 2, 4) if settings.sigma_p == 0 else range(5)
    ):  # a single point has no diagonal to take sigma_p from
        keep = present[row]
        expected = naive(answers[row].numpy(), clean[row, keep].numpy(), normals[row, keep].numpy(), settings)
        assert found[row].item() == pytest.approx(expected, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("loss", PAPERS)
def test_padding_costs_nothing_and_has_no_gradient(loss: str) -> None:
    settings = LossSettings(loss=loss, tangential_weight=0.1)
    answers, clean, normals, present = patches(4)
    wild = clean.clone()
    wild[~present] = 1e3
    turned = normals.clone()
    turned[~present] = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    results = []
    for c, n in ((clean, normals), (wild, turned)):
        leaf = answers.clone().requires_grad_()
        value = filtering_loss(leaf, c, n, present, settings)
        value.sum().backward()
        assert leaf.grad is not None
        assert torch.isfinite(leaf.grad).all()
        results.append((value.detach().numpy(), leaf.grad.numpy()))
    for a, b in zip(*results, strict=True):
        np.testing.assert_allclose(a[:-1], b[:-1], rtol=1e-9)


@pytest.mark.parametrize("loss", ["bilateral", "projection"])
def test_a_point_on_the_surface_has_no_projection_error(loss: LossName) -> None:
    clean = torch.rand(1, 50, 3, generator=torch.Generator().manual_seed(0))
    clean[..., 2] = 0
    normals = torch.tensor([0.0, 0, 1]).expand(1, 50, 3)
    present = torch.ones(1, 50, dtype=torch.bool)
    settings = LossSettings(loss=loss, eta=1.0, tangential_weight=0.0)
    for height in (0.0, 0.1):
        found = filtering_loss(torch.tensor([[0.5, 0.5, height]]), clean, normals, present, settings)
        assert found.item() == pytest.approx(height, abs=1e-6)


# --- the adaptive network's ---


def test_the_distance_to_a_plane_is_the_height_up_to_its_edge() -> None:
    """A plane whose last clean point is the origin: beyond twice the spacing, distances are those to the edge."""
    spacing, normal = 0.1, torch.tensor([0.0, 0.0, 1.0])
    offsets = torch.tensor([[0.0, 0.0, 0.3], [0.15, 0.1, -0.3], [0.0, 0.6, 0.3], [0.5, 0.0, 0.0]])
    distances, beyond = surface_distances(offsets, normal.expand(4, 3), torch.full((4,), spacing))
    assert distances.tolist() == pytest.approx([0.3, 0.3, 0.5, 0.3], abs=1e-5)
    assert beyond.tolist() == pytest.approx([0.0, 0.0, 0.4, 0.3], abs=1e-5)


def test_distances_do_not_depend_on_the_normals_sign_nor_the_frame() -> None:
    generator = torch.Generator().manual_seed(0)
    offsets, normals = torch.randn(2, 30, 3, generator=generator, dtype=torch.float64)
    normals /= normals.norm(dim=1, keepdim=True)
    turn = torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64)).Q
    spacing = torch.full((30,), 0.1, dtype=torch.float64)
    expected = surface_distances(offsets, normals, spacing)
    for found in (
        surface_distances(offsets, -normals, spacing),
        surface_distances(offsets @ turn, normals @ turn, spacing),
    ):
        torch.testing.assert_close(found, expected)
    assert expected[1].max() > 0


def test_a_point_on_the_surface_has_a_gradient() -> None:
    offsets = torch.zeros(1, 3, requires_grad=True)
    distances, _ = surface_distances(offsets, torch.tensor([[0.0, 0.0, 1.0]]), torch.full((1,), 0.1))
    distances.sum().backward()
    assert offsets.grad is not None
    assert torch.isfinite(offsets.grad).all()


def test_the_expectation_s_loss_is_least_at_the_mean() -> None:
    distances = torch.distributions.Exponential(20.0).sample((2_000,)).double() + 0.01
    logs = torch.linspace(-5, 0, 2_001, dtype=torch.float64)
    losses = torch.stack([expectation_loss(log.expand(len(distances)), distances).mean() for log in logs])
    assert logs[losses.argmin()].exp().item() == pytest.approx(distances.mean().item(), rel=5e-3)


def test_distances_below_the_floor_count_as_it() -> None:
    logs = torch.linspace(-9, -3, 1_201, dtype=torch.float64)
    losses = expectation_loss(logs, torch.zeros(len(logs), dtype=torch.float64))
    torch.testing.assert_close(losses, expectation_loss(logs, torch.full_like(logs, FLOOR)))
    assert logs[losses.argmin()].exp().item() == pytest.approx(FLOOR, rel=5e-3)


def answered(count: int, seed: int = 0) -> tuple[Answers, dict[str, torch.Tensor]]:
    """Random answers, and the other tensors of adaptive_loss."""
    generator = torch.Generator().manual_seed(seed)

    def some(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    answers = Answers(0.2 * some(count, 3), some(count) - 2, some(count) - 2, some(count, 3))
    normals = some(count, 3)
    given = {
        "nearest": 0.1 * some(count, 3),
        "normals": normals / normals.norm(dim=1, keepdim=True),
        "still": some(count).abs() * 0.1,
        "queries": 0.2 * some(count, 3),
        "spacing": torch.full((count,), 0.02, dtype=torch.float64),
    }
    return answers, given


def test_the_adaptive_loss_is_the_sum_of_its_terms() -> None:
    settings = LossSettings(tangential_weight=0.3, error_weight=0.2, normal_weight=0.7, uncertain_weight=0.5)
    answers, given = answered(6)
    losses, left = adaptive_loss(answers, **given, settings=settings)
    for row in range(6):
        move, n = answers.displacements[row].numpy(), given["normals"][row].numpy()
        offset = given["queries"][row].numpy() + move - given["nearest"][row].numpy()
        along = np.linalg.norm(offset - (offset @ n) * n)
        distance = math.hypot(offset @ n, max(along - 0.04, 0))
        sideways = np.linalg.norm(move - (move @ n) * n)
        log_moved, log_still = answers.log_moved[row].item(), answers.log_still[row].item()
        errors = max(distance, FLOOR) * math.exp(-log_moved) + log_moved
        errors += max(given["still"][row].item(), FLOOR) * math.exp(-log_still) + log_still
        said = answers.normals[row].numpy()
        cosine = said @ n / np.linalg.norm(said)
        expected = (distance + 0.3 * sideways) / math.sqrt(math.exp(log_moved) + 0.02)
        assert left[row].item() == pytest.approx(distance, rel=1e-6)
        assert losses[row].item() == pytest.approx(expected + 0.2 * errors + 0.7 * (1 - cosine**2), rel=1e-6)


def test_what_the_adaptive_loss_teaches() -> None:
    """Displacements learn from distances alone, expected errors from what is left, and not from one another."""
    answers, given = answered(8, seed=1)
    leaves = Answers(*(value.clone().requires_grad_() for value in answers))
    losses, left = adaptive_loss(leaves, **given, settings=LossSettings(tangential_weight=0.0, error_weight=0.5))
    losses.sum().backward()
    assert not left.requires_grad
    moved, _ = surface_distances(
        given["queries"] + answers.displacements - given["nearest"], given["normals"], given["spacing"]
    )
    for name, distances in (("log_moved", moved), ("log_still", given["still"])):
        slope = 0.5 * (1 - distances.clamp_min(FLOOR) * torch.exp(-getattr(answers, name)))
        torch.testing.assert_close(getattr(leaves, name).grad, slope)
    other = leaves.displacements.grad
    assert other is not None
    again = Answers(*(value.clone().requires_grad_() for value in answers))
    adaptive_loss(again, **given, settings=LossSettings(tangential_weight=0.0, error_weight=0.0))[0].sum().backward()
    torch.testing.assert_close(again.displacements.grad, other)
    assert other.abs().sum() > 0


def test_the_normal_has_no_sign_and_no_length() -> None:
    answers, given = answered(5)
    expected, _ = adaptive_loss(answers, **given, settings=LossSettings())
    found, _ = adaptive_loss(answers._replace(normals=-3 * answers.normals), **given, settings=LossSettings())
    torch.testing.assert_close(found, expected)
    right, _ = adaptive_loss(answers._replace(normals=given["normals"]), **given, settings=LossSettings())
    assert (right < expected).all()
