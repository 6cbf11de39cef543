"""The paper's network (§3.3, Fig. 2): a PointNet encoder, a decoder, one displacement out.

Linear layers on rows of points rather than Conv1d: the same function, and the layout of the patches as they come.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn import functional

GATHERED_VALUES = 2**20  # how much the pooled layer's backward gathers at once: what the caches hold


@dataclass(frozen=True)
class NetworkSettings:
    """Everything that decides the function of the network; saved in checkpoints and in model.json."""

    encoder: tuple[int, ...] = (64, 128, 256, 512, 1024)
    """Widths of the shared layers, from the coordinates up to the patch's feature vector."""
    decoder: tuple[int, ...] = (512, 256)
    """Widths of the layers between the feature vector and the displacement."""
    norm_after_pool: bool = False
    """The last encoder layer's BatchNorm and ReLU after the max instead of before it, as in the paper.

    The gradient then reaches one point a channel, and three quarters of the backward pass become a gather."""

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> NetworkSettings:
        return cls(tuple(values["encoder"]), tuple(values["decoder"]), bool(values["norm_after_pool"]))


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
    """Patches (B, N, 3) float32 in their frames, in units of r, to displacements (B, 3) float32 in the same units."""

    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.settings = settings
        widths = (3, *settings.encoder)
        self.encoder = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        self.encoder_norms = nn.ModuleList(nn.BatchNorm1d(width) for width in settings.encoder)
        widths = (settings.encoder[-1], *settings.decoder)
        self.decoder = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        self.decoder_norms = nn.ModuleList(nn.BatchNorm1d(width) for width in settings.decoder)
        self.head = nn.Linear(widths[-1], 3)

    def encoder_layers(self) -> list[tuple[nn.Linear, nn.BatchNorm1d]]:
        """Each shared layer with its normalisation."""
        return _pairs(self.encoder, self.encoder_norms)

    def decoder_layers(self) -> list[tuple[nn.Linear, nn.BatchNorm1d]]:
        """Each decoder layer with its normalisation; `head` comes after them."""
        return _pairs(self.decoder, self.decoder_norms)

    def forward(self, patches: Tensor) -> Tensor:
        batch, points, _ = patches.shape
        rows = patches.reshape(batch * points, 3)
        *inner, last = self.encoder_layers()
        for layer, norm in inner:
            rows = functional.relu(norm(layer(rows)))
        layer, norm = last
        if self.settings.norm_after_pool:
            # The bias is the same for all points, so it commutes with the max.
            pooled: Tensor = _PooledLinear.apply(rows, layer.weight.to(rows.dtype), batch)  # type: ignore[no-untyped-call]
            features = functional.relu(norm(pooled.float() + layer.bias))
        else:
            features = functional.relu(norm(layer(rows))).view(batch, points, -1).amax(dim=1)
        for layer, norm in self.decoder_layers():
            features = functional.relu(norm(layer(features)))
        with torch.autocast("cpu", enabled=False):
            displacement: Tensor = torch.tanh(self.head(features.float()))
        return displacement


def _pairs(layers: nn.ModuleList, norms: nn.ModuleList) -> list[tuple[nn.Linear, nn.BatchNorm1d]]:
    return list(zip(cast("Iterable[nn.Linear]", layers), cast("Iterable[nn.BatchNorm1d]", norms), strict=True))
