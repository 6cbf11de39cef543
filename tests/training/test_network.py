from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from torch.nn import functional

from training import network as network_module
from training.network import NetworkSettings, Pointfilter, _PooledLinear


@pytest.mark.parametrize("gathered", [1, 2**20])
def test_the_pooled_layer_s_gradient_is_the_dense_one(gathered: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network_module, "GATHERED_VALUES", gathered)
    torch.manual_seed(0)
    rows, weight, direction = torch.randn(6 * 11, 5), torch.randn(9, 5), torch.randn(6, 9)
    results = []
    for pooled in (
        lambda r, w: _PooledLinear.apply(r, w, 6),
        lambda r, w: functional.linear(r, w).view(6, 11, 9).amax(dim=1),
    ):
        r, w = rows.clone().requires_grad_(), weight.clone().requires_grad_()
        value = pooled(r, w)
        (value * direction).sum().backward()
        assert r.grad is not None
        assert w.grad is not None
        results.append([value.detach().numpy(), r.grad.numpy(), w.grad.numpy()])
    for found, expected in zip(*results, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("positive", [True, False])
def test_the_norm_may_come_after_the_max_where_scales_are_positive(positive: bool) -> None:
    torch.manual_seed(0)
    after = Pointfilter(NetworkSettings((16, 32), (8,), norm_after_pool=True))
    before = Pointfilter(NetworkSettings((16, 32), (8,), norm_after_pool=False))
    with torch.no_grad():
        for norm in after.encoder_norms:
            norm.running_mean.normal_()
            norm.running_var.uniform_(0.5, 2)
            norm.weight.normal_()
        if positive:
            after.encoder_norms[-1].weight.abs_()
    before.load_state_dict(after.state_dict())
    patches = torch.randn(4, 20, 3)
    with torch.inference_mode():
        difference = (after.eval()(patches) - before.eval()(patches)).abs().max()
    assert difference < 1e-5 if positive else difference > 1e-3


@pytest.mark.parametrize("norm_after_pool", [True, False])
def test_padding_and_order_do_not_matter(norm_after_pool: bool) -> None:
    torch.manual_seed(0)
    network = Pointfilter(NetworkSettings((16, 32), (8,), norm_after_pool)).eval()
    patches = torch.randn(4, 20, 3)
    patches[:, 0] = 0
    with torch.inference_mode():
        expected = network(patches)
        padded = network(torch.cat([patches, torch.zeros(4, 30, 3)], dim=1))
        shuffled = network(patches[:, torch.randperm(20)])
    torch.testing.assert_close(padded, expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(shuffled, expected, rtol=0, atol=1e-6)


def test_the_default_network_is_the_paper_s() -> None:
    network = Pointfilter(NetworkSettings())
    assert [(layer.in_features, layer.out_features) for layer in network.encoder] == [
        (3, 64), (64, 128), (128, 256), (256, 512), (512, 1024),
    ]  # fmt: skip
    assert [(layer.in_features, layer.out_features) for layer in [*network.decoder, network.head]] == [
        (1024, 512), (512, 256), (256, 3),
    ]  # fmt: skip
    assert (network(torch.randn(2, 5, 3)).abs() < 1).all()


def test_settings_survive_being_plain_values() -> None:
    settings = NetworkSettings((4, 5), (6,), True)
    assert NetworkSettings.from_dict(copy.deepcopy(vars(settings))) == settings
    assert NetworkSettings.from_dict({"encoder": [4, 5], "decoder": [6], "norm_after_pool": True}) == settings
