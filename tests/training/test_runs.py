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

from pointfilter.network import Answers, Network, context
from tests.training.conftest import MadePools
from training import own as own_module
from training import train as train_module
from training.dataset import Batch, TrainingCloud, cut_batch
from training.network import NetworkSettings, Pointfilter
from training.own import as_network, own_clouds
from training.pools import Pools
from training.settings import TrainingSettings
from training.train import Run, start, training_record


def weights(run: Run) -> dict[str, torch.Tensor]:
    states = {"network": run.network.state_dict(), "average": run.average.state_dict()}
    return {f"{name}.{key}": value.clone() for name, state in states.items() for key, value in state.items()}


def saved(folder: Path, name: str = "checkpoint.pt") -> dict[str, Any]:
    state: dict[str, Any] = torch.load(folder / name, weights_only=True)
    return state


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


@pytest.fixture(autouse=True)
def moving(monkeypatch: pytest.MonkeyPatch) -> None:
    """A network that has hardly been trained moves nothing where it may stay."""

    def hopeful(network: Pointfilter) -> Network:
        ask = own_module_as_network(network)

        def answer(*given: np.ndarray) -> Answers:
            said = ask(*given)
            return said._replace(log_errors=said.log_errors - np.float32([100, 0]))

        return answer

    own_module_as_network = own_module.as_network
    monkeypatch.setattr(own_module, "as_network", hopeful)


@pytest.fixture
def straight(tmp_path: Path, tiny: TrainingSettings, pools: MadePools) -> Run:
    run = Run(tmp_path / "straight", tiny)
    run.train(pools)
    return run


@pytest.mark.parametrize("until", [1, 5, 6, 8])  # own clouds are made at step 6
def test_a_run_that_was_stopped_goes_on_exactly(
    until: int, straight: Run, tmp_path: Path, tiny: TrainingSettings, pools: MadePools
) -> None:
    first = Run(tmp_path / "stopped", tiny)
    first.train(pools, until)
    assert first.step == until
    second = Run(tmp_path / "stopped", tiny, saved(tmp_path / "stopped"))
    assert second.step == until
    second.train(pools)
    assert_same(straight, second)


@pytest.mark.parametrize(("killed_at", "goes_on_from"), [(5, 4), (7, 6), (10, 9)])
def test_a_run_that_was_killed_goes_on_from_its_checkpoint_exactly(
    killed_at: int,
    goes_on_from: int,
    straight: Run,
    tmp_path: Path,
    tiny: TrainingSettings,
    pools: MadePools,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with monkeypatch.context() as patch:
        real = train_module.batches_ahead

        def killed(clouds: Any, data: Any, first: int, last: int) -> Iterator[Batch]:
            for step, batch in enumerate(real(clouds, data, first, last), first):
                if step == killed_at:
                    raise KeyboardInterrupt
                yield batch

        patch.setattr(train_module, "batches_ahead", killed)
        with pytest.raises(KeyboardInterrupt):
            Run(tmp_path / "killed", tiny).train(pools)
    second = Run(tmp_path / "killed", tiny, saved(tmp_path / "killed"))
    assert second.step == goes_on_from
    second.train(pools)
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
    assert Run(straight.folder, straight.settings, saved(straight.folder)).step == 12


def test_a_run_writes_its_curve_and_its_settings(straight: Run) -> None:
    with (straight.folder / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    names = ["step", "patches", "hours", "patches_per_second", "learning_rate", "loss", "distance"]
    assert list(rows[0]) == names
    assert [int(row["step"]) for row in rows] == [4, 8, 12]
    assert [int(row["patches"]) for row in rows] == [64, 128, 192]
    assert all(np.isfinite(float(value)) for row in rows for value in row.values())
    described = json.loads((straight.folder / "settings.json").read_text())
    assert TrainingSettings.from_dict(described) == straight.settings
    files = sorted(path.name for path in straight.folder.iterdir())
    assert files == ["checkpoint.pt", "log.csv", "own-1.npz", "settings.json", "stable.pt"]


def test_validation_is_in_the_curve(tmp_path: Path, tiny: TrainingSettings, pools: MadePools) -> None:
    settings = dataclasses.replace(tiny, steps=2, validate_every=2, validation_clouds=1)
    run = Run(tmp_path, settings)
    run.train(pools)
    (row,) = run.history
    assert list(row)[-2:] == ["validation_loss", "validation_distance"]
    assert np.isfinite(row["validation_loss"])
    assert 0 < row["validation_distance"] < 1
    assert run.network.training
    assert training_record(checkpoint(run))["curve"] == [{name: row[name] for name in train_module.CURVE}]


def test_validation_s_loss_is_that_of_the_run_s_progress(
    tmp_path: Path, tiny_paper: TrainingSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = dataclasses.replace(tiny_paper, steps=4, validate_every=2, validation_clouds=1)
    seen: list[float] = []
    real = train_module.filtering_loss

    def loss(*arguments: Any, progress: float) -> torch.Tensor:
        if len(arguments[0]) == 512:  # the validation's batch
            seen.append(progress)
        return real(*arguments, progress=progress)

    monkeypatch.setattr(train_module, "filtering_loss", loss)
    Run(tmp_path, settings).train(Pools(settings.data))
    assert seen == [0.5, 1.0]


@pytest.mark.parametrize("optimizer", ["adamw", "sgd"])
@pytest.mark.parametrize("norm_after_pool", [True, False])
@pytest.mark.parametrize("adaptive", [True, False])
def test_training_lowers_the_loss(
    optimizer: str,
    norm_after_pool: bool,
    adaptive: bool,
    tmp_path: Path,
    tiny: TrainingSettings,
    tiny_paper: TrainingSettings,
    clouds: list[TrainingCloud],
    pools: MadePools,
) -> None:
    settings = tiny if adaptive else tiny_paper
    settings = dataclasses.replace(
        settings,
        network=dataclasses.replace(settings.network, norm_after_pool=norm_after_pool),
        optimizer=optimizer,
        learning_rate=2e-2 if optimizer == "sgd" else 1e-2,
        steps=150,
        ema_decay=0.0,
        weight_decay=0.0,
        validate_every=10**6,
        checkpoint_every=10**6,
        pool_steps=1000,
    )
    run = Run(tmp_path, settings)
    batch = cut_batch(clouds, dataclasses.replace(settings.data, batch=128), 10**6)

    def loss() -> float:
        run.network.train()
        with torch.no_grad():
            return run._loss(run.network, batch, clouds, 0)[0].item()

    before = loss()
    run.train(pools)
    assert loss() < before - 0.2 * abs(before)


@pytest.mark.parametrize("optimizer", ["adamw", "sgd"])
def test_weight_decay_reaches_the_optimizer(optimizer: str, tmp_path: Path, tiny: TrainingSettings) -> None:
    settings = dataclasses.replace(tiny, optimizer=optimizer, weight_decay=0.125)
    run = Run(tmp_path, settings)
    assert [group["weight_decay"] for group in run.optimizer.param_groups] == [0.125]


@pytest.mark.parametrize(("limit", "calls"), [(0.0, []), (0.5, [0.5, 0.5])])
def test_gradients_are_clipped_where_there_is_a_limit(
    limit: float,
    calls: list[float],
    tmp_path: Path,
    tiny: TrainingSettings,
    pools: MadePools,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[float] = []
    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", lambda _, largest: seen.append(largest))
    Run(tmp_path, dataclasses.replace(tiny, gradient_clip=limit)).train(pools, 2)
    assert seen == calls


# --- clouds that the network has filtered ---


def test_own_clouds_are_saved_and_come_from_the_file(
    tmp_path: Path, straight: Run, tiny: TrainingSettings, clouds: list[TrainingCloud]
) -> None:
    network = straight._trained()
    settings = dataclasses.replace(tiny.data, own_every=1, own_points=200)
    made = own_clouds(tmp_path / "own.npz", clouds, network, settings)
    assert [path.name for path in tmp_path.glob("own*")] == ["own.npz"]
    for own, cloud in zip(made, clouds, strict=True):
        assert own.later
        assert own.points.shape == (200, 3)
        assert own.clean is cloud.clean
        assert own.radius == cloud.radius
        stayed = (own.points[:, None] == cloud.points[None]).all(axis=2).any(axis=1)
        assert stayed.mean() < 0.1
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.zero_()
    again = own_clouds(tmp_path / "own.npz", clouds, network, settings)
    anew = own_clouds(tmp_path / "new.npz", clouds, network, settings)
    for first, second in zip(made, again, strict=True):
        np.testing.assert_array_equal(first.points, second.points)
    assert any((first.points != third.points).any() for first, third in zip(made, anew, strict=True))


def test_own_clouds_are_a_share_of_the_clouds(
    tmp_path: Path, straight: Run, tiny: TrainingSettings, clouds: list[TrainingCloud]
) -> None:
    settings = dataclasses.replace(tiny.data, own_every=2, own_points=100)
    made = own_clouds(tmp_path / "own.npz", [*clouds, *clouds, clouds[1]], straight._trained(), settings)
    assert [own.clean for own in made] == [clouds[0].clean, clouds[0].clean, clouds[1].clean]


def test_own_clouds_keep_a_fixed_radius(tmp_path: Path, straight: Run, tiny: TrainingSettings) -> None:
    settings = dataclasses.replace(tiny.data, radius=0.2, own_points=100)
    (own,) = own_clouds(tmp_path / "own.npz", Pools(settings)(0), straight._trained(), settings)
    assert own.radius == pytest.approx(0.2, rel=0.05)


def test_a_run_trains_on_its_own_clouds_as_later_ones(
    tmp_path: Path, tiny: TrainingSettings, pools: MadePools, monkeypatch: pytest.MonkeyPatch
) -> None:
    later: list[bool] = []
    real = train_module.batches_ahead

    def watched(*arguments: Any) -> Iterator[Batch]:
        for batch in real(*arguments):
            later.append(bool(batch.context[:, 1].any()))
            yield batch

    monkeypatch.setattr(train_module, "batches_ahead", watched)
    settings = dataclasses.replace(tiny, data=dataclasses.replace(tiny.data, own_share=1.0))
    Run(tmp_path, settings).train(pools)
    assert later == [False] * 6 + [True] * 6


def test_a_new_run_takes_no_own_clouds_of_another(
    tmp_path: Path, straight: Run, tiny: TrainingSettings, pools: MadePools
) -> None:
    """A run that was killed before its first checkpoint leaves its folder to the next one."""
    np.savez(tmp_path / "own-1.npz", **{"0": np.random.default_rng(0).normal(size=(300, 3))})
    run = Run(tmp_path, tiny)
    run.train(pools)
    assert_same(straight, run)


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
    assert Run(third.folder, tiny, saved(third.folder)).before == third.before


def test_weights_of_another_network_are_refused(tmp_path: Path, straight: Run, tiny: TrainingSettings) -> None:
    wider = dataclasses.replace(tiny, network=dataclasses.replace(tiny.network, encoder=(16, 32)))
    with pytest.raises(ValueError, match="do not fit"):
        start(tmp_path / "new", wider, init=checkpoint(straight))
    assert not (tmp_path / "new").exists()


def test_a_run_that_goes_on_takes_no_other_weights(tmp_path: Path, straight: Run, tiny: TrainingSettings) -> None:
    with pytest.raises(ValueError, match="for a new run"):
        start(straight.folder, tiny, resume=True, init=checkpoint(straight))


def test_the_seed_decides_the_weights(tmp_path: Path, tiny: TrainingSettings) -> None:
    runs = [Run(tmp_path / str(k), dataclasses.replace(tiny, seed=seed)) for k, seed in enumerate((0, 0, 1))]
    first = [next(iter(run.network.state_dict().values())) for run in runs]
    assert torch.equal(first[0], first[1])
    assert not torch.equal(first[0], first[2])


def test_the_learning_rate_warms_up_stays_and_falls_to_nothing(
    tmp_path: Path, tiny: TrainingSettings, pools: MadePools
) -> None:
    run = Run(tmp_path, dataclasses.replace(tiny, steps=20, pool_steps=1000, learning_rate=1e-2))
    rates = [run.scheduler.get_last_lr()[0]]
    for step in range(1, 21):
        run.train(pools, step)
        rates.append(run.scheduler.get_last_lr()[0])
    assert rates[:3] == pytest.approx([1e-2 / 3, 2e-2 / 3, 1e-2])
    assert rates[3:16] == [1e-2] * 13
    assert rates[15:] == pytest.approx([1e-2 * left / 5 for left in range(5, -1, -1)])


@pytest.mark.parametrize("stopped_at", [5, 12])  # before the learning rate falls; at the end, after it fell
def test_a_run_made_longer_is_one_that_was_longer_from_the_start(
    stopped_at: int, tmp_path: Path, tiny: TrainingSettings, pools: MadePools
) -> None:
    longer = dataclasses.replace(tiny, steps=20)
    warm = dataclasses.replace(tiny, steps=12)
    straight = Run(tmp_path / "straight", longer)
    straight.train(pools)
    start(tmp_path / "run", warm, until=stopped_at)
    again = start(tmp_path / "run", warm, resume=True, steps=20)
    assert again.settings == longer
    assert_same(straight, again)


def test_a_run_cannot_get_another_length_once_the_rate_has_fallen(tmp_path: Path, tiny: TrainingSettings) -> None:
    start(tmp_path, tiny)
    (tmp_path / "stable.pt").unlink()
    with pytest.raises(ValueError, match="the checkpoint of step 12 is too late"):
        start(tmp_path, tiny, resume=True, steps=20)
    with pytest.raises(ValueError, match="a run of 8 steps lowers its learning rate from step 6 on"):
        start(tmp_path, tiny, resume=True, steps=8)


def test_the_paper_s_schedule_ends_where_the_paper_says(
    tmp_path: Path, tiny: TrainingSettings, pools: MadePools
) -> None:
    settings = dataclasses.replace(
        tiny, optimizer="sgd", schedule="exponential", learning_rate=1e-4, final_learning_rate=1e-8
    )
    run = Run(tmp_path, settings)
    assert run.scheduler.get_last_lr()[0] == pytest.approx(1e-4)
    run.train(pools)
    assert run.scheduler.get_last_lr()[0] == pytest.approx(1e-8, rel=1e-6)


def test_a_network_is_a_plain_callable(straight: Run) -> None:
    network = straight._trained()
    rng = np.random.default_rng(0)
    patches = rng.uniform(-1, 1, (4, 9, 3)).astype(np.float32)
    queries, owners = patches[[0, 1, 1, 3], 2], np.array([0, 1, 1, 3])
    told = context(np.array([9, 20, 30, 9]), later=True)
    found = as_network(network)(patches, told, queries, owners)
    expected = network.answer(*map(torch.from_numpy, (patches, queries, owners, told)))
    assert found.log_errors is not None
    np.testing.assert_array_equal(found.displacements, expected.displacements.detach())
    np.testing.assert_array_equal(found.log_errors[:, 0], expected.log_moved.detach())
    np.testing.assert_array_equal(found.log_errors[:, 1], expected.log_still.detach())
    np.testing.assert_array_equal(found.normals, expected.normals.detach())


def test_the_paper_s_network_is_one_too(tmp_path: Path, tiny_paper: TrainingSettings) -> None:
    network = Run(tmp_path, tiny_paper)._trained()
    assert network.settings == NetworkSettings((8, 16), (8,), adaptive=False, mean_pool=False)
    patches = np.random.default_rng(0).uniform(-1, 1, (4, 9, 3)).astype(np.float32)
    none = np.zeros((4, 3), np.float32)
    found = as_network(network)(patches, none[:, :2], none, np.arange(4))
    np.testing.assert_array_equal(found.displacements, network(torch.from_numpy(patches)).detach())
    assert found.log_errors is None
    assert found.normals is None
