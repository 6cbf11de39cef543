from __future__ import annotations

import numpy as np
import pytest
import torch

from training.grow import check_growth, grow
from training.network import NetworkSettings, Pointfilter

NARROW = NetworkSettings((8, 16), (8,), norm_after_pool=True)


@pytest.fixture
def narrow() -> Pointfilter:
    """A network whose norms are not the identity."""
    torch.manual_seed(0)
    network = Pointfilter(NARROW)
    with torch.no_grad():
        for norm in (*network.encoder_norms, *network.decoder_norms):
            norm.weight.uniform_(-2, 2)
            norm.bias.normal_()
            norm.running_mean.normal_()
            norm.running_var.uniform_(0.5, 2)
    return network.eval()


@pytest.mark.parametrize(
    ("encoder", "decoder"),
    [((8, 16), (8,)), ((9, 17), (9,)), ((12, 40), (16,)), ((8, 8, 16), (8,)), ((10, 20, 30, 40), (12,))],
)
def test_a_grown_network_is_the_same_function(
    encoder: tuple[int, ...], decoder: tuple[int, ...], narrow: Pointfilter
) -> None:
    wide = grow(narrow, NetworkSettings(encoder, decoder, norm_after_pool=True), torch.randn(64, 20, 3))
    patches = torch.randn(16, 30, 3)
    with torch.inference_mode():
        np.testing.assert_allclose(wide(patches), narrow(patches), atol=1e-5)
    assert not wide.training
    assert all(norm.momentum == 0.1 for norm in (*wide.encoder_norms, *wide.decoder_norms))


def test_what_is_new_learns_too(narrow: Pointfilter) -> None:
    """New units are not heard at first; after one step they are, so that their own weights get gradients."""
    wide = grow(narrow, NetworkSettings((12, 12, 40), (16,), norm_after_pool=True), torch.randn(64, 20, 3)).train()
    patches, target = torch.randn(64, 20, 3), torch.rand(64, 3) - 0.5
    optimizer = torch.optim.SGD(wide.parameters(), 0.1)
    for _ in range(2):
        optimizer.zero_grad()
        (wide(patches) - target).square().mean().backward()
        optimizer.step()
    for layer in (*wide.encoder, *wide.decoder):
        assert layer.weight.grad[-1].abs().max() > 0


@pytest.mark.parametrize(
    "settings",
    [
        NetworkSettings((7, 16), (8,), norm_after_pool=True),
        NetworkSettings((8, 15), (8,), norm_after_pool=True),
        NetworkSettings((8, 7, 16), (8,), norm_after_pool=True),
        NetworkSettings((16,), (8,), norm_after_pool=True),
        NetworkSettings((8, 16), (7,), norm_after_pool=True),
        NetworkSettings((8, 16), (8, 8), norm_after_pool=True),
        NetworkSettings((8, 16), (8,), norm_after_pool=False),
    ],
    ids=str,
)
def test_a_network_that_has_no_room(settings: NetworkSettings, narrow: Pointfilter) -> None:
    with pytest.raises(ValueError, match="do not fit"):
        check_growth(NARROW, settings)
    with pytest.raises(ValueError, match="do not fit"):
        grow(narrow, settings, torch.randn(64, 20, 3))
