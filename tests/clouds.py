"""Clouds and networks that tests work with."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pointfilter import filter as filter_module
from pointfilter.network import Answers, Network

_DIRECTIONS = np.random.default_rng(7).normal(size=(3, 24)).astype(np.float32)
_MIXTURE = (0.1 * np.random.default_rng(8).normal(size=(24, 3))).astype(np.float32)


def paper_network(displace: Callable[[np.ndarray], np.ndarray]) -> Network:
    """The network of the paper's kind that answers with `displace` of its patches."""

    def ask(patches: np.ndarray, context: np.ndarray, queries: np.ndarray, owners: np.ndarray) -> Answers:
        np.testing.assert_array_equal(owners, np.arange(len(patches)))
        assert not queries.any()
        return Answers(displace(patches))

    return ask


def filter_points(points: np.ndarray, network: Network, **options: Any) -> np.ndarray:
    """The points of what the filter gives."""
    return filter_module.filter_points(points, network, **options).points


def pooled_displacements(patches: np.ndarray) -> np.ndarray:
    """A network without a network: max over the points of fixed linear maps, mixed, then tanh.

    Spelled out product by product, so that no library call may add in another order for another batch.
    """
    features = sum(patches[:, :, axis, None] * _DIRECTIONS[axis] for axis in range(3)).max(axis=1)
    mixed = np.zeros((len(patches), 3), dtype=np.float32)
    for channel in range(features.shape[1]):
        mixed += features[:, channel, None] * _MIXTURE[channel]
    return np.tanh(mixed)


def no_displacements(patches: np.ndarray) -> np.ndarray:
    return np.zeros((len(patches), 3), np.float32)


pooled = paper_network(pooled_displacements)
still = paper_network(no_displacements)


def adaptive_pooled(patches: np.ndarray, context: np.ndarray, queries: np.ndarray, owners: np.ndarray) -> Answers:
    """An adaptive network without a network. Its answers differ from query to query; the ratio of its errors depends on
    the points in the ball and their thickness (thin patches prefer large balls), on the pass and on the displacement.
    """
    moves = 0.5 * pooled_displacements(patches)[owners] - 0.3 * queries * np.abs(queries[:, 2:])
    lengths = np.sqrt(np.square(moves).sum(axis=1))
    thickness = np.abs(patches[:, :, 2]).max(axis=1)
    balls = np.abs(context[:, 0] + 1.5 * thickness - 0.5)[owners]
    log_errors = np.stack([balls - 2.0 + 0.5 * context[owners, 1], np.log(lengths + 0.1) + 1.0], axis=1)
    return Answers(moves.astype(np.float32), log_errors.astype(np.float32), np.ones_like(queries))


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
