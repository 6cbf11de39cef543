from __future__ import annotations

import signal
from pathlib import Path

import pytest
import torch
from torch.optim.swa_utils import AveragedModel

from tests.training.conftest import TINY
from training import __main__ as command
from training.presets import load_preset, preset_names
from training.settings import TrainingSettings


def test_every_preset_loads() -> None:
    assert preset_names() == ["default", "paper", "smoke"]
    for name in preset_names():
        assert isinstance(load_preset(name), TrainingSettings)


def test_the_paper_s_preset_has_the_paper_s_numbers() -> None:
    paper = load_preset("paper")
    assert paper.network.encoder == (64, 128, 256, 512, 1024)
    assert paper.network.decoder == (512, 256)
    assert not paper.network.norm_after_pool
    clouds, patches, epochs, batch = 132, 8000, 50, 64
    assert paper.data.clouds == clouds
    assert paper.data.batch == batch
    assert paper.steps == clouds * patches * epochs // batch
    assert (paper.optimizer, paper.schedule) == ("sgd", "exponential")
    assert (paper.learning_rate, paper.final_learning_rate) == (1e-4, 1e-8)
    assert (paper.data.fewest_points, paper.data.most_points, paper.data.clean_points) == (100_000,) * 3
    assert paper.data.noise_levels == (0.0, 0.0025, 0.005, 0.01, 0.015, 0.025)
    assert paper.data.plain_share == 1
    assert (paper.weight_decay, paper.gradient_clip, paper.ema_decay) == (0, 0, 0)
    assert not paper.network.adaptive
    assert (paper.data.radius, paper.data.patch_points) == (0.05, 500)
    loss = paper.loss
    assert (loss.loss, loss.eta, loss.sigma_n_degrees, loss.sigma_p, loss.sigma_p_points) == (
        "bilateral",
        0.97,
        15.0,
        0.0,
        500,
    )
    assert loss.tangential_weight == 0
    assert not loss.theta_squared


def test_settings_can_be_changed_one_by_one() -> None:
    settings = load_preset(
        "smoke",
        [
            "steps=7",
            "loss.eta=0.5",
            "network.encoder=[4, 5]",
            "data.noise_levels=[0.01, 0.02]",
            "pool_steps=5",
            "learning_rate=1",
        ],
    )
    assert (settings.steps, settings.loss.eta, settings.network.encoder) == (7, 0.5, (4, 5))
    assert settings.data.noise_levels == (0.01, 0.02)
    assert settings.pool_steps == 5
    assert settings.learning_rate == 1.0
    assert settings.data.clouds == load_preset("smoke").data.clouds


WRONG = {
    "stepps=7": "stepps",
    "loss.etta=1": "etta",
    "data.loss.eta=1": "loss",
    "steps": "KEY=VALUE",
    "steps=": "KEY=VALUE",
    "steps=seven": "KEY=VALUE",
    'steps="seven"': "steps",
    "steps=7.5": "steps",
    "steps=true": "steps",
    "steps=[7]": "steps",
    "data=7": "data",
    'optimizer="lion"': "adamw",
    'schedule="cosine"': "warmup-stable-decay",
    "decay=0": "decay must be above 0",
    "pool_steps=0": "pool_steps must be at least 1",
    'precision="float64"': "bfloat16",
    'loss.loss="chamfer"': "bilateral",
    'data.noise_levels=["much"]': "noise_levels",
    "pool_steps=0.5": "pool_steps",
    'loss.loss="l2"': "need each other",
    "network.adaptive=false": "need each other",
    'network.encoder=["wide"]': "encoder",
    "network.encoder=[]": "encoder",
    "network.encoder=7": "encoder",
}


@pytest.mark.parametrize("override", WRONG)
def test_a_setting_that_there_is_not(override: str) -> None:
    with pytest.raises(ValueError, match=WRONG[override]):
        load_preset("smoke", [override])


def test_a_network_without_queries_is_asked_for_the_centre_alone() -> None:
    with pytest.raises(ValueError, match=r"data\.queries must be 1"):
        load_preset("smoke", ["network.adaptive=false", 'loss.loss="bilateral"'])


def test_a_preset_that_there_is_not() -> None:
    with pytest.raises(ValueError, match="default, paper, smoke"):
        load_preset("grand")


def test_settings_survive_being_plain_values() -> None:
    import dataclasses

    settings = load_preset("smoke")
    assert TrainingSettings.from_dict(dataclasses.asdict(settings)) == settings


# --- the command ---


def train(out: Path, *arguments: object) -> int:
    options = [word for line in TINY for word in ("--set", line)]
    return command.main(["--out", str(out), "--preset", "smoke", *options, *map(str, arguments)])


def test_the_command_trains_stops_and_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert train(tmp_path / "run", "--until", 3, "--seed", 4) == 0
    assert "3 steps" in capsys.readouterr().out
    state = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    assert (state["settings"]["seed"], state["settings"]["data"]["seed"]) == (4, 4)
    assert command.main(["--out", str(tmp_path / "run"), "--resume"]) == 0
    assert "12 steps" in capsys.readouterr().out
    assert train(tmp_path / "other", "--init", tmp_path / "run" / "checkpoint.pt", "--until", 1) == 0


@pytest.mark.parametrize("change", [["--set", "steps=20"], ["--seed", "1"]], ids=" ".join)
def test_a_run_that_goes_on_takes_no_other_settings(
    change: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(tmp_path / "run", "--until", 1) == 0
    capsys.readouterr()
    assert command.main(["--out", str(tmp_path / "run"), "--resume", *change]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: --resume takes its settings from the checkpoint")
    assert error.count("\n") == 1
    assert torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["step"] == 1


def test_a_run_is_made_longer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert train(tmp_path / "run") == 0
    assert command.main(["--out", str(tmp_path / "run"), "--resume", "--steps", "16"]) == 0
    assert "16 steps" in capsys.readouterr().out
    assert train(tmp_path / "new", "--steps", 16) == 2
    assert "--set steps=N" in capsys.readouterr().err


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_a_run_with_a_checkpoint(
    number: signal.Signals, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = signal.getsignal(number)

    def update(network: AveragedModel, parameters: torch.nn.Module) -> None:
        if network.n_averaged == 2:
            signal.raise_signal(number)
        original(network, parameters)

    original = AveragedModel.update_parameters
    with monkeypatch.context() as patch:
        patch.setattr(AveragedModel, "update_parameters", update)
        assert train(tmp_path / "run") == command.STOPPED
    assert "stopped at step 3" in capsys.readouterr().err
    assert torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["step"] == 3
    assert signal.getsignal(number) is before
    assert command.main(["--out", str(tmp_path / "run"), "--resume"]) == 0


def test_a_signal_before_the_first_batch_leaves_no_checkpoint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def cloud(*_: object) -> None:
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr("training.pools.training_cloud", cloud)
    assert train(tmp_path / "run") == command.STOPPED
    assert "stopped" in capsys.readouterr().err
    assert not (tmp_path / "run" / "checkpoint.pt").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ["--set", "stepps=7"],
        ["--set", 'optimizer="lion"'],
        ["--resume"],
        ["--init", "missing.pt"],
        ["--init", "garbage.pt"],
        ["--init", "empty.pt"],
        ["--init", "other.pt"],
        ["--meshes", "missing"],
        ["--meshes", "empty"],
        ["--clouds", "empty"],
    ],
    ids=" ".join,
)
def test_the_command_says_what_is_wrong(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("empty").mkdir()
    Path("garbage.pt").write_bytes(b"garbage")
    torch.save({}, "empty.pt")
    torch.save({"network": {"layer.weight": torch.zeros(3)}}, "other.pt")
    if arguments == ["--resume"]:
        assert command.main(["--out", str(tmp_path / "run"), *arguments]) == 2
    else:
        assert train(tmp_path / "run", *arguments) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1


@pytest.mark.parametrize(
    "arguments", [["--preset", "grand"], ["--meshes", "a", "--clouds", "b"], ["--until", "soon"]], ids=" ".join
)
def test_wrong_usage(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        command.main(arguments)
    assert caught.value.code == 2
