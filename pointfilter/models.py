"""Model bundles: a folder with model.onnx and model.json.

model.json says what the weights are and how to use them: version, sha256 of model.onnx, architecture, opset, points a
patch, calibration, training record, scores. A bundle without a calibration, as all of schema 1 are, runs in the paper's
mode. Bundles shipped with the package are in bundles/.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from pointfilter.adaptive.calibration import Calibration
from pointfilter.errors import InvalidModelError, ModelNotFoundError

SCHEMA = 2
READABLE = (1, 2)
FRAME = "pca-mean-sign"  # the frame's sign rule that the weights were trained with (patches.py)
BUNDLES = Path(__file__).parent / "bundles"
DEFAULT_MODEL = "pointfilter-adaptive-int8"

AUTO = "auto"

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,99}")
NAME_RULE = "up to 100 letters, digits and . _ + -, the first a letter or digit"

_FIELDS: dict[str, type | tuple[type, ...]] = {
    "schema": int, "name": str, "version": str, "sha256": str, "opset": int, "frame": str, "patch_points": int,
    "precision": str, "parameters": int, "network": dict, "training": dict, "scores": dict,
    "calibration": (dict, type(None)),
}  # fmt: skip
MOST_PATCH_POINTS = 2**16
PRECISIONS = ("float32", "int8")


def parse_iterations(text: str) -> int | None:
    """Most passes, or None for "auto", as options spell it. Raises ValueError; the range is the filter's business."""
    return None if text == AUTO else int(text)


@dataclass(frozen=True)
class ModelBundle:
    """One model: its folder and what its model.json says."""

    folder: Path
    name: str
    version: str
    sha256: str
    opset: int
    patch_points: int
    """Most points of a patch (N in §3.2)."""
    precision: str
    """Of the encoder's products: float32 or int8."""
    parameters: int
    network: dict[str, Any]
    training: dict[str, Any] = field(repr=False)
    scores: dict[str, Any] = field(repr=False)
    calibration: Calibration | None = None
    """How the filter uses the network's expected errors; None: the network does not tell them, the paper's mode."""

    @property
    def onnx(self) -> Path:
        return self.folder / "model.onnx"

    def summary(self) -> dict[str, Any]:
        """What `pointfilter models` and GET /models show."""
        names = (field.name for field in fields(self) if field.name not in ("folder", "calibration"))
        calibration = None if self.calibration is None else self.calibration.as_dict()
        return {**{name: getattr(self, name) for name in names}, "calibration": calibration}


def load_bundle(folder: Path) -> ModelBundle:
    """Reads a bundle and checks its weights against their sha256.

    Raises ModelNotFoundError when there is no bundle, InvalidModelError when it is damaged or of another version.
    """
    try:
        described = json.loads((folder / "model.json").read_text(encoding="utf-8"))
        digest = hashlib.sha256((folder / "model.onnx").read_bytes()).hexdigest()
    except (FileNotFoundError, NotADirectoryError) as error:
        raise ModelNotFoundError(f"no model bundle in {folder.name!r}: it needs model.onnx and model.json") from error
    except ValueError as error:
        raise InvalidModelError(f"model.json of {folder.name!r} is not JSON: {error}") from error
    if not isinstance(described, dict) or described.get("schema") not in READABLE:
        found = described.get("schema") if isinstance(described, dict) else None
        readable = " and ".join(map(str, READABLE))
        raise InvalidModelError(f"model.json of {folder.name!r} has schema {found!r}, this version reads {readable}")
    described.setdefault("calibration", None)
    described.setdefault("precision", PRECISIONS[0])  # bundles from before there were others
    for name, kind in _FIELDS.items():
        if not isinstance(described.get(name), kind):
            raise InvalidModelError(f"model.json of {folder.name!r}: {name!r} is missing or of the wrong type")
    if not 1 <= described["patch_points"] <= MOST_PATCH_POINTS:
        raise InvalidModelError(
            f"model.json of {folder.name!r}: 'patch_points' must be from 1 to {MOST_PATCH_POINTS}, "
            f"not {described['patch_points']!r}"
        )
    if described["calibration"] is not None:
        try:
            described["calibration"] = Calibration.from_dict(described["calibration"])
        except (ValueError, TypeError) as error:
            raise InvalidModelError(f"model.json of {folder.name!r}: {error}") from error
    described["name"] = folder.resolve().name  # a bundle is found by its folder's name, so that is its name
    for name in ("name", "version"):
        if not NAME.fullmatch(described[name]):
            raise InvalidModelError(f"{name} {described[name]!r} of model {folder.name!r} must be {NAME_RULE}")
    if described["precision"] not in PRECISIONS:
        raise InvalidModelError(
            f"precision {described['precision']!r} of model {folder.name!r} must be one of {', '.join(PRECISIONS)}"
        )
    if described["frame"] != FRAME:
        raise InvalidModelError(f"model {folder.name!r} was trained with frames {described['frame']!r}, not {FRAME!r}")
    if described["sha256"] != digest:
        raise InvalidModelError(f"model.onnx of {folder.name!r} has sha256 {digest[:12]}…, its model.json says another")
    known = ModelBundle.__dataclass_fields__.keys() - {"folder"}
    return ModelBundle(folder=folder, **{name: described[name] for name in known})


def available_models(folders: Sequence[Path] = ()) -> dict[str, Path]:
    """Bundle folders by name: those in `folders` (each a folder of bundles), then those in the package."""
    found: dict[str, Path] = {}
    for parent in (*folders, BUNDLES):
        if parent.is_dir():
            for path in sorted(parent.iterdir()):
                if (path / "model.json").is_file():
                    found.setdefault(path.name, path)
    return found


def open_model(name: str | None = None, folders: Sequence[Path] = ()) -> ModelBundle:
    """A model by name, or by folder where the name is a path: for people at a prompt, not for requests from outside.

    Raises ModelNotFoundError, InvalidModelError.
    """
    if name is not None and (os.sep in name or Path(name, "model.json").is_file()):
        return load_bundle(Path(name))
    return find_model(name, folders)


def find_model(name: str | None = None, folders: Sequence[Path] = ()) -> ModelBundle:
    """The bundle of this name (default: DEFAULT_MODEL). Raises ModelNotFoundError, InvalidModelError."""
    name = name or DEFAULT_MODEL
    models = available_models(folders)
    if name not in models:
        raise ModelNotFoundError(f"no model {name!r}", hint=f"known: {', '.join(models) or 'none'}")
    return load_bundle(models[name])
