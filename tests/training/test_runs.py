from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from training import train as train_module
from training.dataset import Batch, TrainingCloud
from training.losses import filtering_loss
from training.train import Run, TrainingSettings, predictor, start, training_record


def weights(run: Run) -> dict[str, torch.Tensor]:
    states = {"network": run.network.state_dict(), "average": run.average.state_dict()}
    return {f"{name}.{key}": value.clone() for name, state in states.items() for key, value in state.items()}


def assert_same(a: Run, b: Run) -> None:
    first, second = weights(a), weights(b)
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert torch.equal(value, second[name]), name
    assert a.step == b.step
    assert str(a.optimizer.state_dict()) == str(b.optimizer.state_dict())
    assert a.scheduler.state_dict() == b.scheduler.state_dict()
    assert a.recent == b.recent
    assert [row["loss"] for row in a.history] == [row["loss"] for row in b.history]


@pytest.fixture
def straight(tmp_path: Path, tiny: TrainingSettings, clouds: list[TrainingCloud]) -> Run:
    run = Run(tmp_path / "straight", tiny, resume=False)
    run.train(clouds)
    return run


@pytest.mark.parametrize("until", [1, 5, 8])
def test_a_run_that_was_stopped_goes_on_exactly(
    until: int, straight: Run, tmp_path: Path, tiny: TrainingSettings, clouds: list[TrainingCloud]
) -> None:
    first = Run(tmp_path / "stopped", tiny, resume=False)
    first.train(clouds, until)
    assert first.step == until
    second = Run(tmp_path / "stopped", tiny, resume=True)
    assert second.step == until
    second.train(clouds)
    assert_same(straight, second)


def test_a_run_that_was_killed_goes_on_from_its_checkpoint_exactly(
    straight: Run, tmp_path: Path, tiny: TrainingSettings, clouds: list[TrainingCloud], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        real = train_module.batches_ahead

        def killed(*arguments: Any) -> Iterator[Batch]:
            for number, batch in enumerate(real(*arguments)):
                if number == 7:
                    raise KeyboardInterrupt
                yield batch

        patch.setattr(train_module, "batches_ahead", killed)
        with pytest.raises(KeyboardInterrupt):
            Run(tmp_path / "killed", tiny, resume=False).train(clouds)
    second = Run(tmp_path / "killed", tiny, resume=True)
    assert second.step == 4
    second.train(clouds)
    assert_same(straight, second)


def test_a_run_is_not_started_over_by_mistake(tmp_path: Path, tiny: TrainingSettings) -> None:
    run = start(tmp_path, tiny, until=2)
    with pytest.raises(FileExistsError, match="--resume"):
        start(tmp_path, tiny)
    assert start(tmp_path, tiny, resume=True, until=2).step == run.step


def test_resuming_takes_the_settings_from_the_checkpoint(tmp_path: Path, tiny: TrainingSettings) -> None:
    start(tmp_path, tiny, until=2)
    run = start(tmp_path, TrainingSettings(), resume=True, until=3)
    assert run.settings == tiny
    assert run.step == 3


def test_resuming_takes_the_data_from_where_the_run_took_it(tmp_path: Path, tiny: TrainingSettings) -> None:
    """A run on one's own clouds must not go on with procedural shapes because an option was not repeated."""
    folder = tmp_path / "clouds"
    folder.mkdir()
    points = np.random.default_rng(0).uniform(size=(400, 3))
    np.save(folder / "a.npy", points)
    np.save(folder / "a_normal.npy", np.tile([0.0, 0, 1], (400, 1)))
    whole = start(tmp_path / "whole", tiny, clouds=folder)
    start(tmp_path / "halved", tiny, clouds=folder, until=5)
    assert_same(whole, start(tmp_path / "halved", tiny, resume=True))


def test_a_kill_while_saving_leaves_the_checkpoint_before(
    straight: Run, clouds: list[TrainingCloud], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = straight.folder / "checkpoint.pt"
    before = path.read_bytes()

    def half(state: object, file: Any) -> None:
        file.write(before[: len(before) // 2])
        raise KeyboardInterrupt

    monkeypatch.setattr(train_module.torch, "save", half)
    straight.step = 99
    with pytest.raises(KeyboardInterrupt):
        straight.save()
    assert path.read_bytes() == before
    assert Run(straight.folder, straight.settings, resume=True).step == 12


def test_a_run_writes_its_curve_and_its_settings(straight: Run) -> None:
    with (straight.folder / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["step", "patches", "hours", "patches_per_second", "learning_rate", "loss"]
    assert [int(row["step"]) for row in rows] == [4, 8, 12]
    assert [int(row["patches"]) for row in rows] == [64, 128, 192]
    assert all(np.isfinite(float(value)) for row in rows for value in row.values())
    described = json.loads((straight.folder / "settings.json").read_text())
    assert TrainingSettings.from_dict(described) == straight.settings
    assert sorted(path.name for path in straight.folder.iterdir()) == ["checkpoint.pt", "log.csv", "settings.json"]


def test_validation_is_in_the_curve(tmp_path: Path, tiny: TrainingSettings, clouds: list[TrainingCloud]) -> None:
    settings = dataclasses.replace(tiny, steps=2, validate_every=2, validation_clouds=1)
    run = Run(tmp_path, settings, resume=False)
    run.train(clouds)
    (row,) = run.history
    assert list(row)[-4:] == ["validation_loss", "noisy_cd", "cd_1", "cd_2"]
    assert all(np.isfinite(value) and value > 0 for value in list(row.values())[-4:])
    assert run.network.training


@pytest.mark.parametrize("optimizer", ["adamw", "sgd"])
@pytest.mark.parametrize("norm_after_pool", [True, False])
def test_training_lowers_the_loss(
    optimizer: str, norm_after_pool: bool, tmp_path: Path, tiny: TrainingSettings, clouds: list[TrainingCloud]
) -> None:
    network = dataclasses.replace(tiny.network, norm_after_pool=norm_after_pool)
    rate = 2e-2 if optimizer == "sgd" else 1e-2
    settings = dataclasses.replace(
        tiny, network=network, optimizer=optimizer, learning_rate=rate, steps=150, ema_decay=0.0, weight_decay=0.0
    )
    settings = dataclasses.replace(settings, validate_every=10**6, checkpoint_every=10**6)
    run = Run(tmp_path, settings, resume=False)
    data = dataclasses.replace(settings.data, batch=128)

    def loss() -> float:
        batch = train_module.cut_batch(clouds, data, 10**6)
        run.network.train()
        with torch.no_grad():
            answers = run.network(batch.patches)
        return filtering_loss(answers, batch.clean, batch.normals, batch.present, settings.loss).mean().item()

    before = loss()
    run.train(clouds)
    assert loss() < 0.8 * before


def checkpoint(run: Run) -> dict[str, object]:
    return torch.load(run.folder / "checkpoint.pt", weights_only=True)


def test_weights_may_be_taken_over(tmp_path: Path, straight: Run, tiny: TrainingSettings) -> None:
    run = start(tmp_path / "new", dataclasses.replace(tiny, seed=5), init=checkpoint(straight), until=0)
    for network in (run.network, run.average.module):
        for key, value in straight.average.module.state_dict().items():
            assert torch.equal(network.state_dict()[key], value)
    assert run.step == 0
    (before,) = run.before
    assert (before["steps"], before["settings"]["seed"]) == (straight.step, tiny.seed)
    third = start(tmp_path / "third", tiny, init=checkpoint(run), until=0)
    assert [record["settings"]["seed"] for record in third.before] == [tiny.seed, 5]
    assert Run(third.folder, tiny, resume=True).before == third.before


def test_a_record_names_no_folder(straight: Run) -> None:
    state = checkpoint(straight)
    state["settings"]["data"]["filtered_by"] = str(Path("my", "private", "bundle"))
    assert training_record(state)["settings"]["data"]["filtered_by"] == "bundle"
    assert state["settings"]["data"]["filtered_by"] == str(Path("my", "private", "bundle"))
    state["before"] = [{"settings": {"data": {"filtered_by": str(Path("my", "older", "one"))}}}]
    (ancestor,) = training_record(state)["before"]
    assert ancestor["settings"]["data"]["filtered_by"] == "one"


def test_a_narrower_network_grows(tmp_path: Path, straight: Run, tiny: TrainingSettings) -> None:
    widths = [2 * width for width in tiny.network.encoder]
    wider = dataclasses.replace(tiny, network=dataclasses.replace(tiny.network, encoder=(*widths[:1], *widths)))
    run = start(tmp_path / "new", wider, init=checkpoint(straight), until=0)
    patches = torch.randn(8, 20, 3)
    with torch.inference_mode():
        np.testing.assert_allclose(run.network.eval()(patches), straight.average.module.eval()(patches), atol=1e-5)


def test_a_run_that_goes_on_takes_no_other_weights(tmp_path: Path, straight: Run, tiny: TrainingSettings) -> None:
    with pytest.raises(ValueError, match="for a new run"):
        start(straight.folder, tiny, resume=True, init=checkpoint(straight))


def test_the_seed_decides_the_weights(tmp_path: Path, tiny: TrainingSettings) -> None:
    runs = [
        Run(tmp_path / str(k), dataclasses.replace(tiny, seed=seed), resume=False) for k, seed in enumerate((0, 0, 1))
    ]
    first = [next(iter(run.network.state_dict().values())) for run in runs]
    assert torch.equal(first[0], first[1])
    assert not torch.equal(first[0], first[2])


def test_the_paper_s_schedule_ends_where_the_paper_says(
    tmp_path: Path, tiny: TrainingSettings, clouds: list[TrainingCloud]
) -> None:
    settings = dataclasses.replace(
        tiny, optimizer="sgd", schedule="exponential", learning_rate=1e-4, final_learning_rate=1e-8
    )
    run = Run(tmp_path, settings, resume=False)
    assert run.scheduler.get_last_lr()[0] == pytest.approx(1e-4)
    run.train(clouds)
    assert run.scheduler.get_last_lr()[0] == pytest.approx(1e-8, rel=1e-6)


def test_a_network_is_a_plain_callable(straight: Run) -> None:
    straight.network.eval()
    answer = predictor(straight.network)(np.zeros((4, 9, 3), np.float32))
    assert answer.shape == (4, 3)
    assert answer.dtype == np.float32
