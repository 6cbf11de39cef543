"""The losses, all in the patch's own units: lengths are fractions of the radius r. Those of §3.3 (Eq. 3 to 7), and the
one of the adaptive network, which answers with its expected errors too."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor
from torch.nn import functional

from training.network import Answers

LossName = Literal["surface", "bilateral", "projection", "l2"]
LOSSES: tuple[LossName, ...] = get_args(LossName)


@dataclass(frozen=True)
class LossSettings:
    """Which loss, and every constant in it."""

    loss: LossName = "surface"
    """surface: adaptive_loss. bilateral: Eq. 7. projection: Eq. 3. l2: squared distance to the nearest clean point
    (Table 5's ablation)."""
    eta: float = 0.97
    """Weight of the projection term; 1 - eta is the repulsion's (Eq. 5)."""
    sigma_p: float = 0.0
    """Support of phi (Eq. 4) in units of r; 0 takes the paper's 4·sqrt(diag/m) from every patch."""
    sigma_p_points: int = 500
    """The paper's m in sigma_p."""
    sigma_p_shrink: float = 1.0
    """What is left of sigma_p at the end of a run; it shrinks geometrically. Below 1 for curved surfaces:
    the best answer to the paper's wide support (about 0.3 r) lies beside them."""
    sigma_n_degrees: float = 15.0
    """Support angle of theta (Eq. 6)."""
    theta_squared: bool = False
    """Square the exponent of theta, as the authors' published code does."""
    tangential_weight: float = 0.2
    """Weight of the displacement's length along the surface. Not in the paper: keeps points from bunching up."""
    error_weight: float = 0.1
    """Weight of the likelihood of each of the two expected errors (surface)."""
    normal_weight: float = 0.1
    """Weight of one minus the squared cosine between the answered and the true normal (surface)."""
    uncertain_weight: float = 0.5
    """The distance is weighted by its expectation to minus this power (surface): 0 lets the patches that hold more
    noise than shape decide everything, 1 is the likelihood itself (beta-NLL: Seitzer et al., 2022)."""


def filtering_loss(
    displacements: Tensor,
    clean: Tensor,
    normals: Tensor,
    present: Tensor,
    settings: LossSettings,
    progress: float = 0.0,
) -> Tensor:
    """The loss of each patch: (B,).

    displacements: (B, 3), the network's answer, so the filtered point itself (the patch is centred).
    clean, normals: (B, M, 3), the clean points in the ball with their unit normals. present: (B, M) bool, False where
    a row is padding. progress: how much of the run is over, 0 to 1. A patch without clean points costs nothing.
    """
    offsets = displacements[:, None, :] - clean
    squared = offsets.square().sum(dim=2)
    nearest = squared.masked_fill(~present, math.inf).argmin(dim=1)
    rows = torch.arange(len(clean))
    nearest_normals = normals[rows, nearest]
    if settings.loss == "l2":
        main = squared[rows, nearest]
    else:
        distances = (offsets * normals).sum(dim=2).abs()
        sigma_p = _sigma_p(clean, present, settings) * settings.sigma_p_shrink**progress
        weights = torch.exp(-squared / sigma_p[:, None].square())
        if settings.loss == "bilateral":
            exponent = (1 - (nearest_normals[:, None, :] * normals).sum(dim=2)) / (
                1 - math.cos(math.radians(settings.sigma_n_degrees))
            )
            weights = weights * torch.exp(-(exponent.square() if settings.theta_squared else exponent))
        weights = weights * present
        main = (distances * weights).sum(dim=1) / weights.sum(dim=1).clamp_min(1e-12)
    repulsion = squared.masked_fill(~present, 0.0).amax(dim=1).clamp_min(1e-12).sqrt()
    loss = settings.eta * main + (1 - settings.eta) * repulsion
    if settings.tangential_weight:
        along = displacements - (displacements * nearest_normals).sum(dim=1, keepdim=True) * nearest_normals
        loss = loss + settings.tangential_weight * (along.square().sum(dim=1) + 1e-12).sqrt()
    return torch.where(present.any(dim=1), loss, torch.zeros_like(loss))


def _sigma_p(clean: Tensor, present: Tensor, settings: LossSettings) -> Tensor:
    if settings.sigma_p:
        return torch.full((len(clean),), settings.sigma_p)
    high = clean.masked_fill(~present[:, :, None], -math.inf).amax(dim=1)
    low = clean.masked_fill(~present[:, :, None], math.inf).amin(dim=1)
    diagonal = (high - low).clamp_min(1e-6).nan_to_num(nan=1.0, posinf=1.0, neginf=1.0).norm(dim=1)
    return 4 * torch.sqrt(diagonal / settings.sigma_p_points)


FLOOR = 1e-3  # of the radius: distances below it count as it, else the logarithm of no distance would have no end
SOFTENING = 0.02  # of the radius: added to an expected error before its power is taken


def surface_distances(offsets: Tensor, normals: Tensor, spacing: Tensor) -> tuple[Tensor, Tensor]:
    """Distance of points to a densely sampled surface, and the length of their offsets along it: two (M,) tensors.

    offsets: (M, 3), from the nearest clean point. normals: (M, 3), its unit normal. spacing: (M,), of the clean points.
    The distance is that to the tangent plane; where the nearest clean point lies further along the plane than samples
    lie apart, the surface has ended, and the rest counts too.
    """
    heights = (offsets * normals).sum(dim=1)
    along = (offsets - heights[:, None] * normals).square().sum(dim=1).clamp_min(1e-12).sqrt()
    beyond = (along - 2 * spacing).clamp_min(0)
    return (heights.square() + beyond.square() + 1e-12).sqrt(), beyond


def expectation_loss(log_expected: Tensor, distances: Tensor) -> Tensor:
    """Negative logarithm of the likelihood of distances (M,) under an exponential distribution with the expected mean;
    its minimum is where the expectation is the mean distance."""
    return distances.clamp_min(FLOOR) * torch.exp(-log_expected) + log_expected


def adaptive_loss(
    answers: Answers, nearest: Tensor, normals: Tensor, still: Tensor, queries: Tensor, spacing: Tensor,
    settings: LossSettings,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """The loss of each query (M,), and the distance that is left to the surface (M,), without gradient.

    nearest: (M, 3), the clean point nearest to the filtered point, in the frame of the patch. normals: (M, 3), there.
    still: (M,), distance of the unfiltered point to the surface. queries: (M, 3), where it is. spacing: (M,).
    """
    distances, _ = surface_distances(queries + answers.displacements - nearest, normals, spacing)
    left = distances.detach()
    moved_along = answers.displacements - (answers.displacements * normals).sum(dim=1, keepdim=True) * normals
    main = distances + settings.tangential_weight * (moved_along.square().sum(dim=1) + 1e-12).sqrt()
    main = main * (answers.log_moved.detach().exp() + SOFTENING).pow(-settings.uncertain_weight)
    errors = expectation_loss(answers.log_moved, left) + expectation_loss(answers.log_still, still)
    cosines = (functional.normalize(answers.normals, dim=1) * normals).sum(dim=1)
    return main + settings.error_weight * errors + settings.normal_weight * (1 - cosines.square()), left
