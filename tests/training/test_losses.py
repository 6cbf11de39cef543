from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from training.losses import LOSSES, LossSettings, filtering_loss


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
    shrinking = LossSettings(sigma_p=0.4, sigma_p_shrink=0.25)
    for progress, sigma_p in ((0.0, 0.4), (0.5, 0.2), (1.0, 0.1)):
        found = filtering_loss(answers, clean, normals, present, shrinking, progress)
        fixed = filtering_loss(answers, clean, normals, present, LossSettings(sigma_p=sigma_p))
        torch.testing.assert_close(found, fixed)


@pytest.mark.parametrize("loss", LOSSES)
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
        {"tangential_weight": 0.2},
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


@pytest.mark.parametrize("loss", LOSSES)
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


def test_a_point_on_the_surface_has_no_projection_error() -> None:
    clean = torch.rand(1, 50, 3)
    clean[..., 2] = 0
    normals = torch.tensor([0.0, 0, 1]).expand(1, 50, 3)
    on = filtering_loss(
        torch.tensor([[0.5, 0.5, 0.0]]), clean, normals, torch.ones(1, 50, dtype=torch.bool), LossSettings(eta=1.0)
    )
    assert on.item() == pytest.approx(0, abs=1e-7)
