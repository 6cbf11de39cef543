from __future__ import annotations

import json
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from pointfilter import PointCloud, __version__, cli, models
from pointfilter.cli import filter as filter_command
from pointfilter.errors import FilteringCancelledError, PointfilterError
from tests.ply_files import ply_bytes

Capture = pytest.CaptureFixture[str]
ADAPTIVE = models.DEFAULT_MODEL  # before it is replaced


@pytest.fixture(autouse=True)
def tiny_is_the_default(bundle_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tiny bundle is the default model here, whatever is shipped."""
    monkeypatch.setenv("POINTFILTER_MODEL_DIR", str(bundle_folder.parent))
    monkeypatch.setattr(models, "DEFAULT_MODEL", "tiny")


def run(*arguments: object) -> int:
    return cli.main([str(argument) for argument in arguments])


def refused(capsys: Capture, code: int, *arguments: object) -> str:
    """Runs a command that must fail with this code; returns what it said, which is one line."""
    assert run(*arguments) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1
    assert "Traceback" not in captured.err
    return captured.err


def test_one_file(noisy_file: Path, tmp_path: Path, capsys: Capture) -> None:
    target = tmp_path / "clean.ply"
    before = noisy_file.read_bytes()
    assert run("filter", noisy_file, target) == 0
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "600 points" in captured.err
    assert noisy_file.read_bytes() == before
    clean = PointCloud.read(target)
    assert (clean.xyz != PointCloud.read(noisy_file).xyz).any()
    assert clean.source is not None
    assert clean.source.summary["comments"][0].startswith("filtered by pointfilter model tiny 0.0.1 ")


def test_options_reach_the_filter(noisy_file: Path, tmp_path: Path, capsys: Capture, bundle_folder: Path) -> None:
    options = ["--iterations", 1, "--radius", "0.25", "--seed", 5, "--threads", 1, "--device", "cpu", "--json"]
    for model in ("tiny", bundle_folder):
        assert run("filter", noisy_file, tmp_path / "a.ply", "--model", model, *options) == 0
        report = json.loads(capsys.readouterr().out)
        assert report["input"] == str(noisy_file)
        assert report["output"] == str(tmp_path / "a.ply")
        assert (report["iterations"], report["radius"], report["seed"], report["threads"]) == (1, 0.25, 5, 1)
        assert (report["model"], report["provider"], report["points"]) == ("tiny", "CPUExecutionProvider", 600)


def test_strength_and_longest_move_reach_the_filter(noisy_file: Path, tmp_path: Path, capsys: Capture) -> None:
    def largest(*options: object) -> float:
        assert run("filter", noisy_file, tmp_path / "a.ply", "--json", *options) == 0
        return float(json.loads(capsys.readouterr().out)["largest_displacement"])

    full = largest()
    assert largest("--strength", 0.5) == pytest.approx(full / 2)
    assert largest("--strength", 0) == 0
    np.testing.assert_array_equal(PointCloud.read(tmp_path / "a.ply").xyz, PointCloud.read(noisy_file).xyz)
    assert largest("--max-move", full / 3) == pytest.approx(full / 3)


def test_normals_reach_the_filter(noisy_file: Path, tmp_path: Path, capsys: Capture) -> None:
    options = ("--quiet", "--model", models.BUNDLES / ADAPTIVE, "--normals")
    for normals, found in (("keep", []), ("recompute", ["nx", "ny", "nz"]), ("drop", [])):
        assert run("filter", noisy_file, tmp_path / "a.ply", *options, normals) == 0
        assert list(PointCloud.read(tmp_path / "a.ply").column_types)[4:] == found
    assert "adaptive model" in refused(capsys, 2, "filter", noisy_file, tmp_path / "b.ply", "--normals", "recompute")


def test_columns_reach_the_filter(noisy_file: Path, tmp_path: Path, capsys: Capture) -> None:
    assert run("filter", noisy_file, tmp_path / "a.ply", "--json", "--columns", "outlier,displacement") == 0
    report = json.loads(capsys.readouterr().out)
    cloud = PointCloud.read(tmp_path / "a.ply")
    assert list(cloud.column_types)[4:] == ["scalar_displacement", "scalar_outlier"]
    assert cloud.column_values(["scalar_displacement"]).max() == pytest.approx(report["largest_displacement"])
    assert "got 'colour'" in refused(capsys, 2, "filter", noisy_file, tmp_path / "b.ply", "--columns", "colour")
    again = refused(capsys, 2, "filter", tmp_path / "a.ply", tmp_path / "b.ply", "--columns", "outlier")
    assert "scalar_outlier" in again


def test_the_paper_s_mode_of_an_adaptive_bundle(noisy_file: Path, tmp_path: Path, capsys: Capture) -> None:
    reports = []
    for options in ([], ["--paper"]):
        assert (
            run("filter", noisy_file, tmp_path / "a.ply", "--json", "--model", models.BUNDLES / ADAPTIVE, *options) == 0
        )
        reports.append(json.loads(capsys.readouterr().out))
    adaptive, paper = reports
    assert adaptive["expected_error"] > 0
    assert adaptive["radius_low"] < adaptive["radius_high"]
    assert (paper["iterations"], paper["expected_error"]) == (2, None)
    assert paper["radius_low"] == paper["radius_high"]


def test_iterations_may_be_left_to_the_cloud(noisy_file: Path, tmp_path: Path, capsys: Capture) -> None:
    assert run("filter", noisy_file, tmp_path / "a.ply", "--iterations", "auto", "--json") == 0
    passes = json.loads(capsys.readouterr().out)["iterations"]
    assert run("filter", noisy_file, tmp_path / "b.ply", "--iterations", passes, "--quiet") == 0
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_the_same_command_gives_the_same_file(noisy_file: Path, tmp_path: Path) -> None:
    for name, threads in (("a.ply", 1), ("b.ply", 3)):
        assert run("filter", noisy_file, tmp_path / name, "--threads", threads, "--quiet") == 0
    a, b = (PointCloud.read(tmp_path / name).xyz for name in ("a.ply", "b.ply"))
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-6)


def test_quiet_is_quiet(noisy_file: Path, tmp_path: Path, capsys: Capture) -> None:
    assert run("filter", noisy_file, tmp_path / "a.ply", "--quiet") == 0
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "")


def test_a_file_onto_itself(noisy_file: Path) -> None:
    before = PointCloud.read(noisy_file).xyz
    assert run("filter", noisy_file, noisy_file) == 0
    after = PointCloud.read(noisy_file).xyz
    assert after.shape == before.shape
    assert (after != before).any()
    assert [path.name for path in noisy_file.parent.iterdir()] == [noisy_file.name]


def test_a_file_into_a_folder_keeps_its_name(noisy_file: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    assert run("filter", noisy_file, tmp_path / "out") == 0
    assert (tmp_path / "out" / noisy_file.name).is_file()


def test_a_folder_into_a_new_folder(noisy_file: Path, tmp_path: Path, capsys: Capture) -> None:
    source = tmp_path / "scans"
    source.mkdir()
    for name in ("b.ply", "a.PLY"):
        shutil.copy(noisy_file, source / name)
    (source / "notes.txt").write_text("no scan")
    assert run("filter", source, tmp_path / "deep" / "out", "--json") == 0
    reports = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [Path(report["input"]).name for report in reports] == ["a.PLY", "b.ply"]
    assert sorted(path.name for path in (tmp_path / "deep" / "out").iterdir()) == ["a.PLY", "b.ply"]


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_another_encoding(encoding: str, noisy_file: Path, tmp_path: Path) -> None:
    assert run("filter", noisy_file, tmp_path / "a.ply", "--format", encoding) == 0
    assert run("filter", noisy_file, tmp_path / "same.ply") == 0
    cloud, same = PointCloud.read(tmp_path / "a.ply"), PointCloud.read(tmp_path / "same.ply")
    assert cloud.source is not None
    assert cloud.source.summary["encoding"] == encoding
    np.testing.assert_array_equal(cloud.xyz, same.xyz)


# --- refusals ---


@pytest.mark.parametrize(
    ("option", "value", "told"),
    [
        ("--radius", "wide", "5%"),
        ("--radius", "-1", "above 0"),
        ("--radius", "200%", "at most 100%"),
        ("--iterations", 0, "from 1 to 100, got 0"),
        ("--iterations", 101, "from 1 to 100, got 101"),
        ("--seed", -1, "seed must be from 0"),
        ("--strength", 1.5, "strength must be from 0 to 1"),
        ("--max-move", -1, "max_move must be a length above 0"),
        ("--threads", -1, "threads must be from 0"),
        ("--device", "tpu", "auto, cpu, openvino"),
    ],
)
def test_parameters_out_of_range(
    option: str, value: object, told: str, noisy_file: Path, tmp_path: Path, capsys: Capture
) -> None:
    assert told in refused(capsys, 2, "filter", noisy_file, tmp_path / "a.ply", f"{option}={value}")
    assert not (tmp_path / "a.ply").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["filter"],
        ["filter", "a.ply"],
        ["polish"],
        ["filter", "a", "b", "--format", "las"],
        ["filter", "a", "b", "--iterations", "two"],
    ],
)
def test_wrong_usage(arguments: list[str], capsys: Capture) -> None:
    with pytest.raises(SystemExit) as caught:
        run(*arguments)
    assert caught.value.code == 2
    assert "usage: pointfilter" in capsys.readouterr().err


INPUTS = {
    "text": (b"hello", "not a PLY file"),
    "truncated": (ply_bytes("binary_little_endian", [(1.0, 2.0, 3.0)] * 9)[:-5], "truncated"),
    "no z": (ply_bytes("ascii", [(1.0, 2.0)], ["float x", "float y"]), "no property z"),
    "one point": (ply_bytes("ascii", [(1.0, 2.0, 3.0)]), "at least 4"),
    "one place": (ply_bytes("ascii", [(1.0, 2.0, 3.0)] * 9), "radius"),
}


@pytest.mark.parametrize("name", INPUTS)
def test_inputs_that_cannot_be_filtered(name: str, tmp_path: Path, capsys: Capture) -> None:
    content, told = INPUTS[name]
    (tmp_path / "in.ply").write_bytes(content)
    assert told in refused(capsys, 3, "filter", tmp_path / "in.ply", tmp_path / "out.ply")
    assert [path.name for path in tmp_path.iterdir()] == ["in.ply"]


def test_suffixes_are_looked_at_before_the_work(
    noisy_file: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object, **__: object) -> None:
        raise AssertionError("the work has begun")

    monkeypatch.setattr(filter_command, "filter_cloud", never)
    assert ".las" in refused(capsys, 3, "filter", noisy_file, tmp_path / "a.las")
    assert str(tmp_path / "nowhere") in refused(capsys, 5, "filter", noisy_file, tmp_path / "nowhere" / "a.ply")


def test_an_empty_folder(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "in").mkdir()
    assert ".ply" in refused(capsys, 3, "filter", tmp_path / "in", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_folder_does_not_fit_into_a_file(noisy_file: Path, tmp_path: Path, capsys: Capture) -> None:
    assert "folder" in refused(capsys, 2, "filter", noisy_file.parent, noisy_file)
    assert "folder" in refused(capsys, 2, "filter", noisy_file.parent, "-")
    assert "folder" in refused(capsys, 2, "filter", "-", tmp_path)


def test_models_that_cannot_be_used(noisy_file: Path, tmp_path: Path, bundle_folder: Path, capsys: Capture) -> None:
    assert "known: tiny" in refused(capsys, 4, "filter", noisy_file, tmp_path / "a.ply", "--model", "grand")
    assert "missing" in refused(capsys, 4, "filter", noisy_file, tmp_path / "a.ply", "--model", tmp_path / "missing")
    broken = shutil.copytree(bundle_folder, tmp_path / "broken")
    (broken / "model.onnx").write_bytes(b"damaged")
    assert "sha256" in refused(capsys, 4, "filter", noisy_file, tmp_path / "a.ply", "--model", broken)


def test_a_device_that_is_not_there(
    noisy_file: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    import onnxruntime

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    assert "device=auto" in refused(capsys, 4, "filter", noisy_file, tmp_path / "a.ply", "--device", "cuda")


def test_files_that_are_not_there(noisy_file: Path, tmp_path: Path, capsys: Capture) -> None:
    missing = tmp_path / "missing.ply"
    assert str(missing) in refused(capsys, 5, "filter", missing, tmp_path / "a.ply")
    assert str(missing) in refused(capsys, 5, "info", missing)
    assert str(missing) in refused(capsys, 5, "evaluate", noisy_file, missing)


def test_an_interruption_leaves_nothing_behind(
    noisy_file: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(PointCloud, "write", interrupted)
    assert run("filter", noisy_file, tmp_path / "a.ply") == 130
    assert capsys.readouterr().err == "interrupted\n"
    assert [path.name for path in tmp_path.iterdir()] == [noisy_file.name]


def test_every_error_that_a_command_can_meet_has_an_exit_code() -> None:
    """Nothing asks the command line to stop but the interrupt."""

    def leaves(kind: type[PointfilterError]) -> list[type[PointfilterError]]:
        core = PointfilterError.__module__  # the service's tests add classes to the same process
        children = [child for child in kind.__subclasses__() if child.__module__ == core]
        return [leaf for child in children for leaf in leaves(child)] or [kind]

    for kind in leaves(PointfilterError):
        assert issubclass(kind, tuple(cli.EXIT_CODES)) or kind is FilteringCancelledError


# --- the others ---


def test_info(noisy_file: Path, capsys: Capture) -> None:
    assert run("info", noisy_file, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    cloud = PointCloud.read(noisy_file)
    assert (found["points"], found["without_a_place"], found["encoding"]) == (600, 0, "binary_little_endian")
    assert found["low"] == cloud.xyz.min(axis=0).tolist()
    assert found["diagonal"] == pytest.approx(np.linalg.norm(np.ptp(cloud.xyz, axis=0)))
    assert run("info", noisy_file) == 0
    text = capsys.readouterr().out
    assert "600 × float x, float y, float z, uchar mark" in text


def test_info_says_how_noisy_a_file_is(noisy_file: Path, capsys: Capture) -> None:
    assert run("info", noisy_file, "--json", "--model", models.BUNDLES / ADAPTIVE, "--threads", 1) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["verdict"], found["warnings"]) == ("noisy", [])
    assert 0.002 < found["noise"] < 0.02
    assert found["encoding"] == "binary_little_endian"
    assert run("info", noisy_file) == 0  # the default model tells no errors here
    assert "cannot tell" in capsys.readouterr().out
    assert run("info", noisy_file, "--brief", "--json", "--model", "grand") == 0
    assert "verdict" not in json.loads(capsys.readouterr().out)
    assert "known: tiny" in refused(capsys, 4, "info", noisy_file, "--model", "grand")


@pytest.mark.parametrize("rows", [[], [(float("nan"), 0.0, 0.0)]])
def test_info_of_a_cloud_that_is_nowhere(rows: list[tuple[float, ...]], tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "a.ply").write_bytes(ply_bytes("ascii", rows))
    assert run("info", tmp_path / "a.ply", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["low"], found["high"], found["diagonal"]) == (None, None, 0)
    assert (found["verdict"], len(found["warnings"])) == ("cannot tell", 1)
    assert run("info", tmp_path / "a.ply") == 0


def test_info_does_not_let_a_file_talk_to_the_terminal(tmp_path: Path, capsys: Capture) -> None:
    data = ply_bytes("ascii", [(1.0, 2.0, 3.0)]).replace(b"end_header", b"comment \x1b[2J\x07 \xc3\xa9\nend_header")
    (tmp_path / "a.ply").write_bytes(
        data.replace(b"float z\n", b"float z\nproperty float \x1b[31m\n").replace(b"3.0\n", b"3.0 4\n")
    )
    assert run("info", tmp_path / "a.ply") == 0
    text = capsys.readouterr().out
    assert all(line.isprintable() for line in text.splitlines())
    assert "é" in text


def test_evaluate(noisy_file: Path, tmp_path: Path, capsys: Capture) -> None:
    assert run("evaluate", noisy_file, noisy_file, "--json") == 0
    rows = json.loads(capsys.readouterr().out)
    assert rows["filtered"]["CD x1e5"] == 0
    other = tmp_path / "other.ply"
    cloud = PointCloud.read(noisy_file)
    cloud.with_xyz(cloud.xyz + 0.01).write(other)
    assert run("evaluate", noisy_file, noisy_file, "--noisy", other) == 0
    text = capsys.readouterr().out
    assert [line.split()[0] for line in text.splitlines()[1:]] == ["noisy", "filtered", "fell"]
    assert "P2F*" in text


def test_evaluate_against_a_mesh(tmp_path: Path, capsys: Capture) -> None:
    rng = np.random.default_rng(0)
    sheet = [(float(x), float(y), 0.0) for x, y in rng.uniform(size=(50, 2))]
    (tmp_path / "clean.ply").write_bytes(ply_bytes("ascii", sheet))
    corners = [(-9.0, -9.0, 0.0), (9.0, -9.0, 0.0), (0.0, 9.0, 0.0)]
    (tmp_path / "mesh.ply").write_bytes(ply_bytes("ascii", corners, faces=[(0, 1, 2)]))
    assert (
        run("evaluate", tmp_path / "clean.ply", tmp_path / "clean.ply", "--mesh", tmp_path / "mesh.ply", "--json") == 0
    )
    assert json.loads(capsys.readouterr().out)["filtered"]["P2F x1e3"] == pytest.approx(0, abs=1e-9)
    assert "faces" in refused(capsys, 3, "evaluate", *[tmp_path / "clean.ply"] * 2, "--mesh", tmp_path / "clean.ply")


def test_models(capsys: Capture) -> None:
    assert run("models", "--json") == 0
    found = {entry["name"]: entry for entry in json.loads(capsys.readouterr().out)}
    assert found["tiny"]["patch_points"] == 64
    assert run("models") == 0
    assert "tiny: version 0.0.1, " in capsys.readouterr().out


def test_doctor(capsys: Capture, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert run("doctor", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["pointfilter"] == __version__
    assert (found["model"], found["provider"]) == ("tiny", "CPUExecutionProvider")
    assert found["first_inference_ms"] > 0
    assert run("doctor") == 0
    assert "onnxruntime" in capsys.readouterr().out
    monkeypatch.setattr(models, "DEFAULT_MODEL", "none of these")
    assert "no model" in refused(capsys, 4, "doctor")


# --- as a process ---


def process(*arguments: object, stdin: bytes = b"") -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [sys.executable, "-m", "pointfilter", *map(str, arguments)], input=stdin, capture_output=True, check=False
    )


def test_from_stdin_to_stdout(noisy_file: Path, tmp_path: Path) -> None:
    done = process("filter", "-", "-", "--model", "tiny", "--json", stdin=noisy_file.read_bytes())
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stderr)["points"] == 600
    assert run("filter", noisy_file, tmp_path / "a.ply") == 0
    assert done.stdout == (tmp_path / "a.ply").read_bytes()


def test_garbage_from_stdin(tmp_path: Path) -> None:
    done = process("filter", "-", tmp_path / "a.ply", "--model", "tiny", stdin=b"garbage")
    assert done.returncode == 3
    assert done.stderr.startswith(b"error: this is not a PLY file")
    assert done.stdout == b""
    assert list(tmp_path.iterdir()) == []


def test_the_version() -> None:
    done = process("--version")
    assert done.returncode == 0
    assert done.stdout.decode().split() == ["pointfilter", __version__]


@pytest.mark.skipif(sys.platform == "win32", reason="needs permissions")
def test_a_folder_that_must_not_be_written_to(noisy_file: Path, tmp_path: Path, capsys: Capture) -> None:
    folder = tmp_path / "locked"
    folder.mkdir()
    folder.chmod(stat.S_IRUSR | stat.S_IXUSR)
    try:
        (folder / "probe").touch()
    except PermissionError:
        refused(capsys, 5, "filter", noisy_file, folder / "a.ply")
    else:
        pytest.skip("this user may write everywhere")
    finally:
        folder.chmod(stat.S_IRWXU)
