"""The network: the paper's (§3.3, Fig. 2), a PointNet encoder and a decoder that answers with one displacement, and the
adaptive one, whose decoder answers for several query points of a patch, with expected errors and a normal for each.

Linear layers on rows of points rather than Conv1d: the same function, and the layout of the patches as they come.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

from pointfilter.network import by_length

CONTEXT = 5  # inputs of the decoder beside the features: the query's place (3), points in the ball, a later pass or not
ANSWERS = 8  # displacement (3), two logarithms of errors, normal (3)
GATHERED_VALUES = 2**20  # how much the pooled layer's backward gathers at once: what the caches hold


@dataclass(frozen=True)
class NetworkSettings:
    """Everything that decides the function of the network; saved in checkpoints and in model.json."""

    encoder: tuple[int, ...] = (64, 64, 128, 384)
    """Widths of the shared layers, from the coordinates up to the patch's feature vector."""
    decoder: tuple[int, ...] = (768, 384)
    """Widths of the layers between the feature vector and the displacement."""
    norm_after_pool: bool = True
    """The last encoder layer's BatchNorm and ReLU after the max instead of before it, as in the paper.

    The gradient then reaches one point a channel, and three quarters of the backward pass become a gather."""
    adaptive: bool = True
    """Answer for query points, with expected errors and normals, knowing the points in the ball and the pass."""
    mean_pool: bool = True
    """The decoder sees the mean over the patch of what goes into the last encoder layer beside the max of what comes
    out of it: a max does not average noise. (A sum served PCPNet better than a max: Guerrero et al., 2018.)"""

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> NetworkSettings:
        return cls(
            tuple(values["encoder"]),
            tuple(values["decoder"]),
            bool(values["norm_after_pool"]),
            bool(values.get("adaptive", False)),
            bool(values.get("mean_pool", False)),
        )

    @property
    def features(self) -> int:
        """Width of a patch's feature vector."""
        return self.encoder[-1] + (([3, *self.encoder])[-2] if self.mean_pool else 0)


class Answers(NamedTuple):
    """What the network says of M query points, in the frames of their patches and in units of r.

    displacements: (M, 3). log_moved, log_still: (M,), logarithms of the expected distance to the surface after the
    displacement and without it. normals: (M, 3), of the surface at the moved point, of any sign and length.
    """

    displacements: Tensor
    log_moved: Tensor
    log_still: Tensor
    normals: Tensor


class _PooledLinear(torch.autograd.Function):
    """max over the points of x @ w.T, with a backward that visits only the points that won."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, weight: Tensor, batch: int) -> Tensor:
        values: Tensor
        values, winners = functional.linear(rows, weight).view(batch, -1, len(weight)).max(dim=1)
        ctx.save_for_backward(rows, weight, winners)
        return values

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        rows, weight, winners = ctx.saved_tensors
        batch, channels = winners.shape
        width = weight.shape[1]
        chosen = winners + torch.arange(0, len(rows), len(rows) // batch)[:, None]
        scale = gradients[0].to(rows.dtype)[:, :, None]
        rows_gradient = torch.zeros(rows.shape, dtype=torch.float32)
        weight_gradient = torch.zeros(weight.shape, dtype=torch.float32)
        step = max(1, GATHERED_VALUES // (channels * width))
        for part in (slice(start, start + step) for start in range(0, batch, step)):
            picked = chosen[part].flatten()
            gathered = rows.index_select(0, picked).view(-1, channels, width)
            weight_gradient += (gathered * scale[part]).sum(dim=0, dtype=torch.float32)
            rows_gradient.index_add_(0, picked, (weight * scale[part]).view(-1, width).float())
        return rows_gradient.to(rows.dtype), weight_gradient.to(weight.dtype), None


class Pointfilter(nn.Module):
    """Patches (B, N, 3) float32 in their frames, in units of r, to answers for their query points."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.settings = settings
        widths = (3, *settings.encoder)
        self.encoder = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        self.encoder_norms = nn.ModuleList(nn.BatchNorm1d(width) for width in settings.encoder)
        widths = (settings.features + (CONTEXT if settings.adaptive else 0), *settings.decoder)
        self.decoder = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        self.decoder_norms = nn.ModuleList(nn.BatchNorm1d(width) for width in settings.decoder)
        self.head = nn.Linear(widths[-1], ANSWERS if settings.adaptive else 3)

    def encoder_layers(self) -> list[tuple[nn.Linear, nn.BatchNorm1d]]:
        """Each shared layer with its normalisation."""
        return _pairs(self.encoder, self.encoder_norms)

    def decoder_layers(self) -> list[tuple[nn.Linear, nn.BatchNorm1d]]:
        """Each decoder layer with its normalisation; `head` comes after them."""
        return _pairs(self.decoder, self.decoder_norms)

    def encode(self, patches: Tensor, counts: Tensor | None = None) -> Tensor:
        """The feature vectors (B, C) of patches (B, N, 3). counts: (B,) int64, points of the patches; rows that
        are padding cost nothing then."""
        batch, points, _ = patches.shape
        groups = [(points, torch.arange(batch))]
        if counts is not None:
            groups = [(length, torch.from_numpy(group)) for length, group in by_length(counts.numpy(), points)]
        rows = torch.cat([patches[group, :length].reshape(-1, 3) for length, group in groups])
        *inner, last = self.encoder_layers()
        for layer, norm in inner:
            rows = functional.relu(norm(layer(rows)))
        lengths = [length * len(group) for length, group in groups]
        back = torch.argsort(torch.cat([group for _, group in groups]))
        means = []
        if self.settings.mean_pool:
            for part, (length, group) in zip(torch.split(rows, lengths), groups, strict=True):
                means.append(_mean(part.view(len(group), length, -1), patches[group, :length]))
        layer, norm = last
        if not self.settings.norm_after_pool:
            rows = functional.relu(norm(layer(rows)))
        pooled = []
        for part, (_, group) in zip(torch.split(rows, lengths), groups, strict=True):
            if self.settings.norm_after_pool:
                pooled.append(_PooledLinear.apply(part, layer.weight.to(part.dtype), len(group)))  # type: ignore[no-untyped-call]
            else:
                pooled.append(part.view(len(group), -1, part.shape[1]).amax(dim=1))
        features = torch.cat(pooled)[back]
        if self.settings.norm_after_pool:  # the bias is the same for all points, so it commutes with the max
            features = functional.relu(norm(features.float() + layer.bias))
        return torch.cat([features, torch.cat(means)[back]], dim=1) if means else features

    def forward(self, patches: Tensor) -> Tensor:
        """The paper's network: displacements (B, 3) of the centres."""
        return torch.tanh(self._decode(self.encode(patches)))

    def answer(
        self, patches: Tensor, queries: Tensor, owners: Tensor, context: Tensor, counts: Tensor | None = None
    ) -> Answers:
        """The adaptive network. queries: (M, 3), points of the patches `owners` (M,) int64 in their frames.
        context: (B, 2), see `context`. counts: see `encode`."""
        values = self._decode(self.encode(patches, counts), queries, owners, context)
        return Answers(torch.tanh(values[:, :3]), values[:, 3], values[:, 4], values[:, 5:])

    def _decode(
        self,
        features: Tensor,
        queries: Tensor | None = None,
        owners: Tensor | None = None,
        context: Tensor | None = None,
    ) -> Tensor:
        (layer, norm), *others = self.decoder_layers()
        if queries is None or owners is None or context is None:
            features = layer(features)
        else:  # what a patch's queries share is multiplied once
            width = features.shape[1]
            shared = functional.linear(torch.cat([features, context], dim=1), _without_queries(layer.weight, width))
            features = shared[owners] + functional.linear(queries, layer.weight[:, width : width + 3], layer.bias)
        features = functional.relu(norm(features))
        for layer, norm in others:
            features = functional.relu(norm(layer(features)))
        with torch.autocast("cpu", enabled=False):
            values: Tensor = self.head(features.float())
        return values


def _mean(rows: Tensor, patches: Tensor) -> Tensor:
    """The means (B, C) of rows (B, N, C) over the points of patches (B, N, 3), but not over the centres and padding,
    which are zeros."""
    present = (patches != 0).any(dim=2)[:, None, :].to(rows.dtype)
    return torch.bmm(present, rows)[:, 0].float() / present.sum(dim=2).float().clamp_min(1)


def context(counts: Tensor, later: Tensor) -> Tensor:
    """What the decoder is told of a patch beside its points: (B, 2) float32.

    counts: (B,) points in its ball: a max over points cannot count. later: (B,) bool, whether the cloud has been
    through a pass already.
    """
    return torch.stack([torch.log2(counts.float()) / 6 - 1, later.float()], dim=1)


def _without_queries(weight: Tensor, width: int) -> Tensor:
    """The columns of the first decoder layer's weight that see features and context, not the queries."""
    return torch.cat([weight[:, :width], weight[:, width + 3 :]], dim=1)


def _pairs(layers: nn.ModuleList, norms: nn.ModuleList) -> list[tuple[nn.Linear, nn.BatchNorm1d]]:
    return list(zip(cast("Iterable[nn.Linear]", layers), cast("Iterable[nn.BatchNorm1d]", norms), strict=True))
