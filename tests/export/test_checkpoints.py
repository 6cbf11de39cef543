from __future__ import annotations

import os
import pickle
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from export.bundle import write_bundle
from export.checkpoint import load_checkpoint
from pointfilter import Engine
from training.train import CHECKPOINT_VERSION

WIDTHS = (3, 8, 12, 16, 24, 32)


class Encoder(nn.Module):
    """As the paper's authors wrote theirs, narrower."""

    def __init__(self) -> None:
        super().__init__()
        for number, (a, b) in enumerate(pairwise(WIDTHS), 1):
            setattr(self, f"conv{number}", nn.Conv1d(a, b, 1))
            setattr(self, f"bn{number}", nn.BatchNorm1d(b))

    def forward(self, x: Tensor) -> Tensor:
        for number in range(1, len(WIDTHS)):
            x = functional.relu(getattr(self, f"bn{number}")(getattr(self, f"conv{number}")(x)))
        return x.max(dim=2).values


class Decoder(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.fc1, self.fc2, self.fc3 = nn.Linear(WIDTHS[-1], 16), nn.Linear(16, 8), nn.Linear(8, 3)
        self.bn1, self.bn2 = nn.BatchNorm1d(16), nn.BatchNorm1d(8)

    def forward(self, x: Tensor) -> Tensor:
        x = functional.relu(self.bn1(self.fc1(x)))
        return torch.tanh(self.fc3(functional.relu(self.bn2(self.fc2(x)))))


class Authors(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.encoder, self.decoder = Encoder(), Decoder()

    def forward(self, x: Tensor) -> Tensor:
        answer: Tensor = self.decoder(self.encoder(x))
        return answer


@pytest.fixture
def authors() -> Authors:
    torch.manual_seed(0)
    network = Authors()
    for _ in range(3):
        network(torch.randn(32, 3, 20))
    with torch.no_grad():
        for module in network.modules():
            if isinstance(module, nn.BatchNorm1d):
                module.weight.normal_()
                module.bias.normal_()
    return network.eval()


@pytest.mark.parametrize("wrapped", [True, False])
def test_the_authors_checkpoints_answer_as_their_network_does(wrapped: bool, authors: Authors, tmp_path: Path) -> None:
    path = tmp_path / "authors.pth"
    weights = authors.state_dict()
    torch.save({"epoch": 50, "state_dict": weights} if wrapped else weights, path)
    loaded = load_checkpoint(path)
    assert loaded.patch_points == 500
    bundle, _ = write_bundle(loaded, tmp_path / "authors", "0")
    assert bundle.calibration is None  # the paper's mode
    engine = Engine(bundle, "cpu")
    for length in (1, 40, 500):
        patches = np.random.default_rng(length).uniform(-1, 1, (6, length, 3)).astype(np.float32)
        with torch.inference_mode():
            expected = authors(torch.from_numpy(patches.transpose(0, 2, 1).copy())).numpy()
        none = np.zeros((6, 3), np.float32)
        answer = engine(patches, none[:, :2], none, np.arange(6))
        np.testing.assert_allclose(answer.displacements, expected, rtol=0, atol=1e-5)
        assert answer.log_errors is None


def test_a_checkpoint_of_the_authors_with_a_gap(authors: Authors, tmp_path: Path) -> None:
    weights = authors.state_dict()
    del weights["encoder.bn3.running_mean"]
    torch.save({"state_dict": weights}, tmp_path / "gap.pth")
    with pytest.raises(ValueError, match=r"encoder\.bn3\.running_mean"):
        load_checkpoint(tmp_path / "gap.pth")


def test_a_checkpoint_of_the_authors_of_another_shape(authors: Authors, tmp_path: Path) -> None:
    weights = authors.state_dict()
    weights["encoder.conv2.weight"] = torch.zeros(12, 9, 1)
    torch.save({"state_dict": weights}, tmp_path / "shape.pth")
    with pytest.raises(ValueError, match="shape"):
        load_checkpoint(tmp_path / "shape.pth")


class Bomb:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("how", ["torch", "pickle"])
def test_code_in_a_checkpoint_is_not_run(how: str, tmp_path: Path) -> None:
    path, harm = tmp_path / "bomb.pt", tmp_path / "harm"
    if how == "torch":
        torch.save({"settings": Bomb(harm), "average": {}}, path)
    else:
        path.write_bytes(pickle.dumps(Bomb(harm)))
    with pytest.raises(ValueError, match="read safely"):
        load_checkpoint(path)
    assert not harm.exists()


CONTENTS: dict[str, object] = {
    "a tensor": torch.zeros(3),
    "a list": [1, 2],
    "nothing": {},
    "another network": {"state_dict": {"conv.weight": torch.zeros(3)}},
    "no weights": {"state_dict": 7},
    "half of ours": {"settings": {}, "average": {}},
    "another version of ours": {"settings": {}, "average": {}, "version": 99},
    "an older version of ours": {"settings": {}, "average": {}, "version": 1},
    "ours without its parts": {"settings": {}, "average": {}, "version": CHECKPOINT_VERSION},
    "ours of other types": {"settings": 5, "average": 5, "version": CHECKPOINT_VERSION},
}


@pytest.mark.parametrize("name", CONTENTS)
def test_a_checkpoint_that_is_none(name: str, tmp_path: Path) -> None:
    path = tmp_path / "other.pt"
    torch.save(CONTENTS[name], path)
    with pytest.raises(ValueError, match=r"other\.pt"):
        load_checkpoint(path)


@pytest.mark.parametrize(
    "content", [b"", b"garbage", b"PK\x03\x04" + bytes(100), b"\x80\x02}q\x00."], ids=["empty", "text", "zip", "pickle"]
)
def test_a_file_that_is_no_checkpoint(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "garbage.pt"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"garbage\.pt"):
        load_checkpoint(path)


def test_a_missing_checkpoint_is_the_system_s_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        load_checkpoint(tmp_path / "missing.pt")
