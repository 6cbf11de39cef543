"""Clouds and networks that tests work with."""

from __future__ import annotations

import numpy as np

_DIRECTIONS = np.random.default_rng(7).normal(size=(3, 24)).astype(np.float32)
_MIXTURE = (0.1 * np.random.default_rng(8).normal(size=(24, 3))).astype(np.float32)


def pooled(patches: np.ndarray) -> np.ndarray:
    """A network without a network: max over the points of fixed linear maps, mixed, then tanh.

    Spelled out product by product, so that no library call may add in another order for another batch.
    """
    features = sum(patches[:, :, axis, None] * _DIRECTIONS[axis] for axis in range(3)).max(axis=1)
    mixed = np.zeros((len(patches), 3), dtype=np.float32)
    for channel in range(features.shape[1]):
        mixed += features[:, channel, None] * _MIXTURE[channel]
    return np.tanh(mixed)


def still(patches: np.ndarray) -> np.ndarray:
    """A network that moves nothing."""
    return np.zeros((len(patches), 3), np.float32)


def crease(count: int, rng: np.random.Generator, angle: float = 1.2) -> np.ndarray:
    """(count, 3) points on two unit squares that share an edge and enclose `angle`."""
    along, across = rng.uniform(size=(2, count))
    turned = rng.random(count) < 0.5
    x = np.where(turned, across * np.cos(angle), across)
    z = np.where(turned, across * np.sin(angle), 0.0)
    return np.column_stack([x, along, z])


def rotation(rng: np.random.Generator) -> np.ndarray:
    """A random proper rotation."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q
