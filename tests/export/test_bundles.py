from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from export import __main__ as command
from export import bundle as bundle_module
from export import calibration as calibration_module
from export.bundle import ParityError, RoundingError, write_bundle
from export.checkpoint import Loaded, load_checkpoint
from pointfilter import Engine, load_bundle
from training.dataset import Batch
from training.network import NetworkSettings, Pointfilter
from training.own import UNCALIBRATED
from training.presets import load_preset
from training.train import Run


def loaded(seed: int = 0, adaptive: bool = False) -> Loaded:
    torch.manual_seed(seed)
    network = Pointfilter(NetworkSettings((8, 16), (8,), norm_after_pool=True, adaptive=adaptive)).eval()
    return Loaded(network, patch_points=32, training={"steps": 5})


@pytest.fixture(autouse=True)
def small_calibration(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration_module, "CLOUDS", 2)
    monkeypatch.setattr(calibration_module, "POINTS", (300,))


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    """What a run leaves behind, before its first step."""
    settings = load_preset("smoke", ["network.encoder=[8, 16]", "network.decoder=[8]", "steps=10"])
    run = Run(tmp_path / "run", settings)
    run.save()
    return tmp_path / "run" / "checkpoint.pt"


def test_a_bundle_says_where_it_comes_from(tmp_path: Path) -> None:
    source = loaded()
    bundle, error = write_bundle(source, tmp_path / "deep" / "mine", "1.2", scores={"cd": 1.0})
    assert error <= bundle_module.PARITY_TOLERANCE
    assert bundle == load_bundle(tmp_path / "deep" / "mine")
    assert (bundle.name, bundle.version, bundle.patch_points) == ("mine", "1.2", 32)
    assert bundle.calibration is None
    assert (bundle.training, bundle.scores) == ({"steps": 5}, {"cd": 1.0})
    assert bundle.network == {"encoder": [8, 16], "decoder": [8], "norm_after_pool": True, "adaptive": False}
    assert bundle.parameters == sum(parameter.numel() for parameter in source.network.parameters())
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["mine"]
    Engine(bundle, "cpu").warm_up()


def test_an_adaptive_bundle_has_a_calibration(tmp_path: Path) -> None:
    bundle, _ = write_bundle(loaded(adaptive=True), tmp_path / "mine", "1")
    calibration = bundle.calibration
    assert calibration is not None
    assert bundle.network["adaptive"] is True
    assert calibration.balls == UNCALIBRATED.balls
    assert calibration.preference in calibration_module.PREFERENCES
    assert calibration.margin in calibration_module.MARGINS
    assert json.loads((bundle.folder / "model.json").read_text())["calibration"] == calibration.as_dict()
    Engine(bundle, "cpu").warm_up()


def inputs() -> dict[str, np.ndarray]:
    """What an engine is asked: one query a patch, its centre."""
    patches = np.random.default_rng(5).uniform(-1, 1, (100, 32, 3)).astype(np.float32)
    told = np.zeros((100, 2), np.float32)
    return {"patches": patches, "context": told, "queries": np.zeros((100, 3), np.float32), "owners": np.arange(100)}


@pytest.fixture
def typical(monkeypatch: pytest.MonkeyPatch) -> None:
    """Patches for the ranges of int8 without shapes to sample."""
    real = bundle_module.typical_batch

    def batch(patch_points: int, step: int, patches: int = 256) -> Batch:
        points = np.random.default_rng(step).uniform(-1, 1, (patches, patch_points, 3)).astype(np.float32)
        some = real(patch_points, step, patches)
        return dataclasses.replace(some, patches=torch.from_numpy(points))

    monkeypatch.setattr(bundle_module, "typical_batch", batch)


@pytest.mark.parametrize("adaptive", [False, True])
def test_an_int8_bundle_answers_nearly_the_same(adaptive: bool, tmp_path: Path, typical: None) -> None:
    exact, _ = write_bundle(loaded(adaptive=adaptive), tmp_path / "exact", "1")
    rounded, _ = write_bundle(loaded(adaptive=adaptive), tmp_path / "rounded", "1", int8=True)
    assert (exact.precision, rounded.precision) == ("float32", "int8")
    expected, answers = (Engine(bundle, "cpu")(**inputs()).displacements for bundle in (exact, rounded))
    told = json.loads((rounded.folder / "model.json").read_text())["rounding_error"]
    found = np.linalg.norm(answers - expected, axis=1).mean() / np.linalg.norm(expected, axis=1).mean()
    assert 0 < found < 0.05
    assert told == pytest.approx(found, rel=0.5)
    assert json.loads((exact.folder / "model.json").read_text())["rounding_error"] == 0


def test_int8_that_changes_too_much_leaves_nothing_behind(
    tmp_path: Path, typical: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bundle_module, "encoder_ranges", lambda *_: [1e-4])
    with pytest.raises(RoundingError, match=r"more than 0\.05"):
        write_bundle(loaded(), tmp_path / "mine", "1", int8=True)
    assert list(tmp_path.iterdir()) == []


def test_typical_patches_are_of_every_kind() -> None:
    first, second = (bundle_module.typical_batch(48, step).patches.numpy() for step in (0, 1))
    assert first.shape == second.shape == (bundle_module.CALIBRATION_PATCHES, 48, 3)
    assert (first != second).any()
    assert np.abs(first).max() <= 1
    thickness = first.std(axis=1)[:, 2]
    assert thickness.min() < 0.01
    assert thickness.max() > 0.3


def test_a_parity_failure_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = bundle_module.build(loaded(seed=1).network)
    monkeypatch.setattr(bundle_module, "build", lambda network: other)
    with pytest.raises(ParityError, match="differ by"):
        write_bundle(loaded(), tmp_path / "mine", "1")
    assert list(tmp_path.iterdir()) == []


def test_a_parity_failure_leaves_the_old_bundle_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    old, _ = write_bundle(loaded(), tmp_path / "mine", "1")
    monkeypatch.setattr(bundle_module, "parity_error", lambda *_: float("nan"))
    with pytest.raises(ParityError):
        write_bundle(loaded(seed=1), tmp_path / "mine", "2")
    assert load_bundle(tmp_path / "mine") == old


def test_a_bundle_can_be_replaced(tmp_path: Path) -> None:
    write_bundle(loaded(), tmp_path / "mine", "1")
    new, _ = write_bundle(loaded(seed=1), tmp_path / "mine", "2")
    assert load_bundle(tmp_path / "mine") == new
    assert new.version == "2"
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize("call", ["write_bytes", "write_text", "replace"])
def test_a_replacement_that_fails_leaves_the_old_bundle(
    call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old, _ = write_bundle(loaded(), tmp_path / "mine", "1")

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, call, full)
        with pytest.raises(OSError, match="No space"):
            write_bundle(loaded(seed=1), tmp_path / "mine", "2")
    assert load_bundle(tmp_path / "mine") == old
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_a_folder_that_is_no_bundle_is_not_overwritten(tmp_path: Path) -> None:
    """`--out bundles` for `--out bundles/mine` must not cost all the bundles in it."""
    write_bundle(loaded(), tmp_path / "bundles" / "mine", "1")
    (tmp_path / "diary").mkdir()
    (tmp_path / "diary" / "dear.txt").write_text("dear")
    (tmp_path / "file").write_text("")
    for name in ("bundles", "diary", "file"):
        with pytest.raises(ValueError, match=name):
            write_bundle(loaded(seed=1), tmp_path / name, "2")
    assert load_bundle(tmp_path / "bundles" / "mine").version == "1"
    assert (tmp_path / "diary" / "dear.txt").read_text() == "dear"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bundles", "diary", "file"]


@pytest.mark.parametrize("version", ["", "../1", "a b"])
def test_a_version_that_is_no_name_writes_nothing(version: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="the version must be"):
        write_bundle(loaded(), tmp_path / "mine", version)
    assert list(tmp_path.iterdir()) == []


# --- the command ---


def test_the_command_exports_a_run(checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "scores.json").write_text('{"cd": 0.8}')
    out = tmp_path / "out" / "mine"
    arguments = [str(checkpoint), "--out", str(out), "--version", "7", "--scores", str(tmp_path / "scores.json")]
    assert command.main(arguments) == 0
    bundle = load_bundle(out)
    assert (bundle.version, bundle.scores) == ("7", {"cd": 0.8})
    assert bundle.calibration is not None
    assert bundle.training["settings"]["network"]["encoder"] == [8, 16]
    assert bundle.training["steps"] == 0
    assert f"{bundle.parameters} parameters" in capsys.readouterr().out


def test_the_average_is_exported_and_not_the_last_weights(checkpoint: Path) -> None:
    state = torch.load(checkpoint, weights_only=True)
    for value in state["network"].values():
        value.zero_()
    torch.save(state, checkpoint)

    def answer() -> torch.Tensor:
        torch.manual_seed(0)
        given = torch.randn(2, 9, 3), torch.zeros(2, 3), torch.arange(2), torch.zeros(2, 2)
        return load_checkpoint(checkpoint).network.answer(*given).displacements.detach()

    assert answer().abs().max() > 0
    state["settings"]["ema_decay"] = 0.0
    torch.save(state, checkpoint)
    np.testing.assert_array_equal(answer(), 0)


@pytest.mark.parametrize(
    "arguments",
    [
        ["missing.pt"],
        ["garbage.pt"],
        ["good", "--version", "../7"],
        ["good", "--scores", "garbage.pt"],
        ["good", "--scores", "missing.json"],
    ],
)
def test_the_command_says_what_is_wrong(
    arguments: list[str],
    checkpoint: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("garbage.pt").write_bytes(b"garbage")
    arguments = [str(checkpoint) if argument == "good" else argument for argument in arguments]
    assert command.main([*arguments, "--out", "out/mine"]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1
    assert not Path("out").exists()


def test_model_json_holds_no_numbers_that_json_has_not(tmp_path: Path) -> None:
    write_bundle(loaded(), tmp_path / "mine", "1")

    def refuse(name: str) -> None:
        raise AssertionError(name)

    json.loads((tmp_path / "mine" / "model.json").read_text(), parse_constant=refuse)
