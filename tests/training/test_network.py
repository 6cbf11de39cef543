from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from torch.nn import functional

from training import network as network_module
from training.network import NetworkSettings, Pointfilter, _PooledLinear, context
from training.presets import load_preset


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
    after = Pointfilter(NetworkSettings((16, 32), (8,), norm_after_pool=True, adaptive=False))
    before = Pointfilter(NetworkSettings((16, 32), (8,), norm_after_pool=False, adaptive=False))
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
    network = Pointfilter(NetworkSettings((16, 32), (8,), norm_after_pool, adaptive=False)).eval()
    patches = torch.randn(4, 20, 3)
    patches[:, 0] = 0
    with torch.inference_mode():
        expected = network(patches)
        padded = network(torch.cat([patches, torch.zeros(4, 30, 3)], dim=1))
        shuffled = network(patches[:, torch.randperm(20)])
    torch.testing.assert_close(padded, expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(shuffled, expected, rtol=0, atol=1e-6)


def test_the_paper_s_network_has_the_paper_s_widths() -> None:
    network = Pointfilter(load_preset("paper").network)
    assert [(layer.in_features, layer.out_features) for layer in network.encoder] == [
        (3, 64), (64, 128), (128, 256), (256, 512), (512, 1024),
    ]  # fmt: skip
    assert [(layer.in_features, layer.out_features) for layer in [*network.decoder, network.head]] == [
        (1024, 512), (512, 256), (256, 3),
    ]  # fmt: skip
    assert (network(torch.randn(2, 5, 3)).abs() < 1).all()


def test_the_mean_leaves_out_centre_and_padding() -> None:
    torch.manual_seed(0)
    network = Pointfilter(NetworkSettings((16, 32), (8,))).eval()
    patches = torch.randn(3, 20, 3)
    patches[:, 0] = 0
    patches[1, 8:] = 0
    layer, norm = network.encoder_layers()[0]
    with torch.inference_mode():
        features = network.encode(patches, torch.tensor([20, 8, 20]))
        for patch, length in enumerate((20, 8, 20)):
            expected = functional.relu(norm(layer(patches[patch, 1:length]))).mean(dim=0)
            torch.testing.assert_close(features[patch, 32:], expected)
        nothing = network.encode(torch.zeros(1, 5, 3), torch.tensor([1]))[:, 32:]
    assert not nothing.any()


def test_settings_survive_being_plain_values() -> None:
    settings = NetworkSettings((4, 5), (6,), True, True)
    assert NetworkSettings.from_dict(copy.deepcopy(vars(settings))) == settings
    before = NetworkSettings.from_dict({"encoder": [4, 5], "decoder": [6], "norm_after_pool": True})
    assert before == NetworkSettings((4, 5), (6,), True, adaptive=False, mean_pool=False)


# --- the adaptive network ---


def adaptive(norm_after_pool: bool = True, seed: int = 0) -> Pointfilter:
    """Random weights, and running statistics off their defaults."""
    torch.manual_seed(seed)
    network = Pointfilter(NetworkSettings((16, 32), (48, 32), norm_after_pool, adaptive=True))
    with torch.no_grad():
        for norm in [*network.encoder_norms, *network.decoder_norms]:
            norm.weight.normal_()
            norm.bias.normal_()
            norm.running_mean.normal_()
            norm.running_var.uniform_(0.5, 2)
    return network.eval()


def asked() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Patches (4, 20, 3), queries (7, 3), owners (7,) and context (4, 2)."""
    generator = torch.Generator().manual_seed(5)
    patches = torch.rand(4, 20, 3, generator=generator) * 2 - 1
    patches[:, 0] = 0
    owners = torch.tensor([0, 1, 2, 3, 2, 0, 2])
    queries = torch.cat([torch.zeros(4, 3), patches[[2, 0, 2], [3, 5, 7]]])
    told = context(torch.tensor([20, 40, 300, 20]), torch.tensor([False, True, False, True]))
    return patches, queries, owners, told


@pytest.mark.parametrize("norm_after_pool", [True, False])
def test_what_queries_share_is_what_they_would_have_each(norm_after_pool: bool) -> None:
    """The decoder of the paper on [features, query, context], one row a query."""
    network = adaptive(norm_after_pool)
    patches, queries, owners, told = asked()
    with torch.inference_mode():
        found = network.answer(patches, queries, owners, told)
        rows = patches
        for layer, norm in network.encoder_layers():
            means = torch.stack(
                [row[(patch != 0).any(dim=1)].mean(dim=0) for row, patch in zip(rows, patches, strict=True)]
            )
            rows = functional.linear(rows, layer.weight, layer.bias)
            if not (norm_after_pool and norm is network.encoder_norms[-1]):
                rows = functional.relu(norm(rows.flatten(0, 1)).view_as(rows))
        features = rows.amax(dim=1)
        if norm_after_pool:
            features = functional.relu(network.encoder_norms[-1](features))
        values = torch.cat([features[owners], means[owners], queries, told[owners]], dim=1)
        for layer, norm in network.decoder_layers():
            values = functional.relu(norm(layer(values)))
        values = network.head(values)
    expected = (values[:, :3].tanh(), values[:, 3], values[:, 4], values[:, 5:])
    for name, value, right in zip(found._fields, found, expected, strict=True):
        torch.testing.assert_close(value, right, rtol=1e-5, atol=1e-5, msg=name)
    assert found.displacements.shape == found.normals.shape == (7, 3)


def test_the_answer_depends_on_query_pass_and_count() -> None:
    network = adaptive()
    patches, queries, owners, told = asked()
    with torch.inference_mode():
        expected = network.answer(patches, queries, owners, told)
        for changed in (
            (patches, queries + 0.3, owners, told),
            (patches, queries, owners, told + torch.tensor([1.0, 0.0])),
            (patches, queries, owners, torch.stack([told[:, 0], 1 - told[:, 1]], dim=1)),
        ):
            other = network.answer(*changed)
            assert all((a - b).abs().max() > 1e-3 for a, b in zip(expected, other, strict=True))


def test_a_query_s_answer_does_not_depend_on_the_others() -> None:
    network = adaptive()
    patches, queries, owners, told = asked()
    with torch.inference_mode():
        expected = network.answer(patches, queries, owners, told)
        alone = network.answer(patches[2:3], queries[4:5], torch.tensor([0]), told[2:3])
    for one, all_of_them in zip(alone, expected, strict=True):
        torch.testing.assert_close(one[0], all_of_them[4], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("norm_after_pool", [True, False])
def test_a_patch_is_evaluated_at_its_own_length(norm_after_pool: bool) -> None:
    torch.manual_seed(0)
    network = Pointfilter(NetworkSettings((8, 16), (8,), norm_after_pool))
    counts = torch.tensor([3, 32, 33, 64, 200, 0])
    patches = torch.randn(6, 64, 3)
    for patch, count in zip(patches, counts, strict=True):
        patch[count:] = 0.0  # as pointfilter.patches pads them; a row of zeros is the centre once more
    patches[:, 0] = 0.0
    network.train()
    seen = []
    network.encoder[0].register_forward_hook(lambda _, given, __: seen.append(len(given[0])))
    network.encode(patches, counts)
    assert seen == [3 * 32 + 3 * 64]  # 0, 3 and 32 points at a length of 32
    network.eval()
    for parameter in network.encoder_norms.parameters():
        torch.nn.init.uniform_(parameter)
    assert torch.allclose(network.encode(patches, counts), network.encode(patches), atol=1e-6)
