"""A wide network that starts as the function of a narrow one (Net2Net: Chen, Goodfellow, Shlens, 2016).

The narrow network's units become the first units of each layer; the new ones beside them start at random, and the old
ones do not listen to them yet. Layers that the wide network has more of are inserted before the encoder's last one and
pass on what they get: activations are positive there, so ReLU lets them through.
"""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from training.network import NetworkSettings, Pointfilter


def grow(narrow: Pointfilter, settings: NetworkSettings, patches: Tensor) -> Pointfilter:
    """The network of `settings` with the narrow one's function, both in evaluation mode.

    patches: (B, N, 3) float32, some hundreds of typical ones: the statistics of the new units are measured on them.
    Raises ValueError where check_growth does.
    """
    check_growth(narrow.settings, settings)
    old = narrow.settings
    extra = len(settings.encoder) - len(old.encoder)
    encoder = _kept_widths(old.encoder, extra)
    wide = Pointfilter(settings)
    narrow_encoder = narrow.encoder_layers()
    inserted = range(len(old.encoder) - 1, len(old.encoder) - 1 + extra)
    sources = [*narrow_encoder[:-1], *[None] * extra, narrow_encoder[-1], *narrow.decoder_layers()]
    width = 3
    with torch.no_grad():
        for (layer, norm), source, kept in zip(
            [*wide.encoder_layers(), *wide.decoder_layers()], sources, (*encoder, *old.decoder), strict=True
        ):
            layer.weight[:kept, width:] = 0
            if source is None:
                layer.weight[:kept, :width] = torch.eye(kept)
                layer.bias[:kept] = 0
            else:
                _copy(*source, layer, norm)
            width = kept
        wide.head.weight[:, width:] = 0
        wide.head.weight[:, :width] = narrow.head.weight
        wide.head.bias[:] = narrow.head.bias
        for number in inserted:  # what such a layer's norm takes away, its weight and bias give back
            _measure(wide, patches)
            _, norm = wide.encoder_layers()[number]
            kept = encoder[number]
            mean, variance = _statistics(norm)
            norm.weight[:kept] = torch.sqrt(variance[:kept] + norm.eps)
            norm.bias[:kept] = mean[:kept]
        _measure(wide, patches)
        for (_, norm), source in zip([*wide.encoder_layers(), *wide.decoder_layers()], sources, strict=True):
            if source is not None:
                for mine, its in zip(_statistics(norm), _statistics(source[1]), strict=True):
                    mine[: len(its)] = its
    return wide.eval()


def check_growth(old: NetworkSettings, new: NetworkSettings) -> None:
    """Raises ValueError unless each layer of `new` has room for its counterpart in `old`, after inserted layers."""
    extra = len(new.encoder) - len(old.encoder)
    if (
        old.norm_after_pool != new.norm_after_pool
        or len(old.decoder) != len(new.decoder)
        or extra < 0
        or (extra and len(old.encoder) < 2)  # there must be a layer with positive activations to pass on
        or any(wide < kept for wide, kept in zip(new.encoder, _kept_widths(old.encoder, extra), strict=True))
        or any(wide < kept for wide, kept in zip(new.decoder, old.decoder, strict=True))
    ):
        raise ValueError(f"the weights to start from do not fit the network, nor do they grow into it: {old}, {new}")


def _kept_widths(encoder: tuple[int, ...], extra: int) -> tuple[int, ...]:
    """Units of each layer that belong to the narrow network, the inserted layers included."""
    return (*encoder[:-1], *encoder[-2:-1] * extra, encoder[-1])


def _copy(source: nn.Linear, source_norm: nn.BatchNorm1d, layer: nn.Linear, norm: nn.BatchNorm1d) -> None:
    rows, columns = source.weight.shape
    layer.weight[:rows, :columns] = source.weight
    layer.bias[:rows] = source.bias
    norm.weight[:rows] = source_norm.weight
    norm.bias[:rows] = source_norm.bias


def _statistics(norm: nn.BatchNorm1d) -> tuple[Tensor, Tensor]:
    """The running mean and variance, the buffers themselves."""
    return cast("Tensor", norm.running_mean), cast("Tensor", norm.running_var)


def _measure(network: Pointfilter, patches: Tensor) -> None:
    """Sets all running statistics to those of these patches."""
    norms = [module for module in network.modules() if isinstance(module, nn.BatchNorm1d)]
    for norm in norms:
        norm.reset_running_stats()
        norm.momentum = None
    network.train()
    network(patches)
    for norm in norms:
        norm.momentum = 0.1
