from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pointfilter import ModelBundle, available_models, find_model, load_bundle
from pointfilter.errors import InvalidModelError, ModelNotFoundError
from pointfilter.models import BUNDLES, FRAME, SCHEMA

Change = Callable[[dict[str, Any]], object]


@pytest.fixture
def copy(bundle_folder: Path, tmp_path: Path) -> Path:
    """The tiny bundle, free to be damaged."""
    folder = tmp_path / "copy"
    shutil.copytree(bundle_folder, folder)
    return folder


def change(folder: Path, alter: Change) -> None:
    path = folder / "model.json"
    described = json.loads(path.read_text())
    alter(described)
    path.write_text(json.dumps(described))


def test_a_bundle_says_what_its_file_says(bundle: ModelBundle, bundle_folder: Path) -> None:
    described = json.loads((bundle_folder / "model.json").read_text())
    assert described["schema"] == SCHEMA
    assert described["frame"] == FRAME
    for name, value in bundle.summary().items():
        assert described[name] == value
    assert bundle.onnx == bundle_folder / "model.onnx"


@pytest.mark.parametrize("missing", ["model.json", "model.onnx", None])
def test_what_is_not_there_is_not_found(missing: str | None, copy: Path) -> None:
    if missing is None:
        shutil.rmtree(copy)
    else:
        (copy / missing).unlink()
    with pytest.raises(ModelNotFoundError, match="copy"):
        load_bundle(copy)


def test_a_file_is_no_bundle(tmp_path: Path) -> None:
    path = tmp_path / "model"
    path.write_bytes(b"")
    with pytest.raises(ModelNotFoundError):
        load_bundle(path)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[1]", b"null", b"7", b'"text"'])
def test_a_description_that_is_none(content: bytes, copy: Path) -> None:
    (copy / "model.json").write_bytes(content)
    with pytest.raises(InvalidModelError, match="copy"):
        load_bundle(copy)


def test_altered_weights_are_noticed(copy: Path) -> None:
    weights = bytearray((copy / "model.onnx").read_bytes())
    weights[len(weights) // 2] ^= 1
    (copy / "model.onnx").write_bytes(weights)
    with pytest.raises(InvalidModelError, match="sha256"):
        load_bundle(copy)


CALIBRATION = {
    "balls": [24, 48], "preference": 0.1, "still_weight": 0.5, "margin": 0.0, "passes": 3, "query_reach": 0.4,
    "error_factor": 1.2,
}  # fmt: skip
CHANGES: dict[str, Change] = {
    "another schema": lambda d: d.update(schema=SCHEMA + 1),
    "no schema": lambda d: d.pop("schema"),
    "another frame": lambda d: d.update(frame="pca-third-moment"),
    "another digest": lambda d: d.update(sha256="0" * 64),
    **{
        f"no {name}": lambda d, name=name: d.pop(name)
        for name in (
            "name",
            "version",
            "sha256",
            "patch_points",
            "network",
            "training",
            "scores",
        )
    },
    "a precision that nobody knows": lambda d: d.update(precision="int4"),
    "a version of two lines": lambda d: d.update(version="1\n2"),
    "points as text": lambda d: d.update(patch_points="64"),
    "no points": lambda d: d.update(patch_points=0),
    "negative points": lambda d: d.update(patch_points=-5),
    "too many points": lambda d: d.update(patch_points=10**6),
    "a calibration that is none": lambda d: d.update(calibration=[1]),
    "a calibration without balls": lambda d: d.update(calibration={**CALIBRATION, "balls": []}),
    "a calibration that lacks a number": lambda d: d.update(calibration={"balls": [24]}),
}


def test_a_bundle_from_before_there_were_precisions(copy: Path) -> None:
    change(copy, lambda d: d.pop("precision", None))
    assert load_bundle(copy).precision == "float32"


def test_a_bundle_of_schema_1_runs_in_the_paper_s_mode(copy: Path) -> None:
    def old(d: dict[str, Any]) -> None:
        d.pop("calibration", None)
        d.update(schema=1, radius=0.05, iterations="auto")

    change(copy, old)
    assert load_bundle(copy).calibration is None


def test_a_calibration_is_read_and_shown(copy: Path) -> None:
    change(copy, lambda d: d.update(calibration=CALIBRATION))
    bundle = load_bundle(copy)
    assert bundle.calibration is not None
    assert bundle.calibration.balls == (24, 48)
    assert bundle.summary()["calibration"] == CALIBRATION


def test_the_folder_names_the_model(copy: Path) -> None:
    assert load_bundle(copy).name == "copy"


def test_a_name_that_no_header_could_hold(copy: Path) -> None:
    odd = copy.rename(copy.with_name("mod\u00e8le copy"))
    with pytest.raises(InvalidModelError, match="letters, digits"):
        load_bundle(odd)


@pytest.mark.parametrize("name", CHANGES)
def test_a_description_that_does_not_fit(name: str, copy: Path) -> None:
    load_bundle(copy)
    change(copy, CHANGES[name])
    with pytest.raises(InvalidModelError, match="copy"):
        load_bundle(copy)


def test_models_are_found_by_name_the_first_folder_first(copy: Path, bundle_folder: Path) -> None:
    second = bundle_folder.parent
    shutil.copytree(copy, copy.parent / "tiny")
    (copy.parent / "empty").mkdir()
    (copy.parent / "file").write_text("")
    found = available_models([copy.parent, second, copy.parent / "missing"])
    shipped = {path.parent.name for path in BUNDLES.glob("*/model.json")}
    assert found.keys() == {"copy", "tiny"} | shipped
    assert found["tiny"] == copy.parent / "tiny"
    assert find_model("copy", [copy.parent]).folder == copy


def test_an_unknown_model_says_what_there_is(copy: Path) -> None:
    with pytest.raises(ModelNotFoundError, match=r"no model 'other' \(known: copy"):
        find_model("other", [copy.parent])
