"""Networks out of checkpoints: ours, and those of the authors' published code."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from training.network import NetworkSettings, Pointfilter
from training.train import CHECKPOINT_VERSION, trained_network, training_record

AUTHORS_PATCH_POINTS = 500
_AUTHORS_KEYS = (
    "encoder.conv1.weight", "encoder.bn1.weight", "decoder.fc1.weight", "decoder.bn1.weight", "decoder.fc3.weight",
)  # fmt: skip


@dataclass(frozen=True)
class Loaded:
    """A network in inference mode, and what is known about how it came to be."""

    network: Pointfilter
    patch_points: int
    training: dict[str, Any]


def load_checkpoint(path: Path) -> Loaded:
    """Reads a checkpoint of `python -m training` or of the authors' code; which one, its content says.

    Nothing in the file is executed: only tensors and plain values are read. Raises ValueError for anything else.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise
    except Exception as error:
        raise ValueError(f"{path} is no checkpoint that can be read safely: {_first_line(error)}") from error
    if not isinstance(state, dict):
        raise ValueError(f"{path} holds a {type(state).__name__}, not a checkpoint")
    weights = state.get("state_dict", state)
    try:
        if "settings" in state and "average" in state:
            return _ours(state, path)
        if isinstance(weights, dict) and all(key in weights for key in _AUTHORS_KEYS):
            return _authors(weights)
    except (KeyError, TypeError, AttributeError, RuntimeError) as error:
        raise ValueError(f"{path} is a damaged checkpoint: {_first_line(error)}") from error
    raise ValueError(f"{path} is neither a checkpoint of `python -m training` nor one of the authors' code")


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _ours(state: dict[str, Any], path: Path) -> Loaded:
    if state.get("version") != CHECKPOINT_VERSION:
        raise ValueError(
            f"{path} has checkpoint version {state.get('version')!r}, this code reads {CHECKPOINT_VERSION}"
        )
    data = state["settings"]["data"]
    return Loaded(trained_network(state), data["patch_points"], training_record(state))


def _authors(weights: dict[str, Tensor]) -> Loaded:
    """conv1..5 are 1 × 1 convolutions: linear layers with one axis too many."""
    encoder = _widths(weights, r"encoder\.conv(\d+)\.weight")
    decoder = _widths(weights, r"decoder\.fc(\d+)\.weight")
    network = Pointfilter(
        NetworkSettings(tuple(encoder), tuple(decoder[:-1]), norm_after_pool=False, adaptive=False, mean_pool=False)
    )
    for number, layer in enumerate(network.encoder, 1):
        _fill(layer, weights, f"encoder.conv{number}")
    for number, norm in enumerate(network.encoder_norms, 1):
        _fill(norm, weights, f"encoder.bn{number}")
    for number, layer in enumerate([*network.decoder, network.head], 1):
        _fill(layer, weights, f"decoder.fc{number}")
    for number, norm in enumerate(network.decoder_norms, 1):
        _fill(norm, weights, f"decoder.bn{number}")
    return Loaded(network.eval(), AUTHORS_PATCH_POINTS, {"source": "checkpoint of the authors' published code"})


def _widths(weights: dict[str, Tensor], pattern: str) -> list[int]:
    found = {int(match[1]): len(weights[key]) for key in weights if (match := re.fullmatch(pattern, key))}
    return [found[number] for number in sorted(found)]


def _fill(module: nn.Module, weights: dict[str, Tensor], prefix: str) -> None:
    for name, target in module.state_dict().items():
        if name == "num_batches_tracked":
            continue
        key = f"{prefix}.{name}"
        if key not in weights:
            raise ValueError(f"the checkpoint has no {key}")
        target.copy_(weights[key].reshape(target.shape))
