"""Checkpoint -> bundle: graph, parity check, model.json."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from numpy.typing import NDArray

from export.checkpoint import Loaded
from export.graph import OPSET, build
from pointfilter.filtering import MAX_ITERATIONS
from pointfilter.models import AUTO, FRAME, NAME, NAME_RULE, SCHEMA, Auto, ModelBundle, load_bundle
from pointfilter.patches import NeighbourIndex, stable_ids

PARITY_TOLERANCE = 1e-5  # of the radius


class ParityError(RuntimeError):
    """torch and onnxruntime disagree, so nothing was exported."""


def write_bundle(
    loaded: Loaded, folder: Path, version: str, iterations: int | Auto = AUTO, scores: dict[str, Any] | None = None
) -> tuple[ModelBundle, float]:
    """Writes the bundle folder (its name is the model's name), whole or not at all but for the instant between two
    renames when it takes the place of an older one.

    Returns the bundle as the service will load it, and the parity error. Raises ParityError above PARITY_TOLERANCE,
    ValueError where the folder is there and is no bundle.
    """
    if iterations != AUTO and not 1 <= iterations <= MAX_ITERATIONS:
        raise ValueError(f"iterations must be from 1 to {MAX_ITERATIONS}, got {iterations}")
    folder = folder.resolve()
    for what, text in (("the folder's name", folder.name), ("the version", version)):
        if not NAME.fullmatch(text):
            raise ValueError(f"{what} must be {NAME_RULE}, not {text!r}")
    if folder.exists() and not _is_bundle(folder):
        raise ValueError(f"{folder} is there and is no bundle: choose another name, nothing is overwritten")
    model = build(loaded.network)
    serialised = model.SerializeToString()
    error = parity_error(loaded, serialised)
    if not error <= PARITY_TOLERANCE:
        raise ParityError(f"torch and onnxruntime differ by {error:.3g} of the radius, more than {PARITY_TOLERANCE:g}")
    settings = loaded.network.settings
    described = {
        "schema": SCHEMA,
        "name": folder.name,
        "version": version,
        "sha256": hashlib.sha256(serialised).hexdigest(),
        "opset": OPSET,
        "frame": FRAME,
        "patch_points": loaded.patch_points,
        "radius": loaded.radius,
        "iterations": iterations,
        "parameters": sum(parameter.numel() for parameter in loaded.network.parameters()),
        "network": {
            "encoder": list(settings.encoder),
            "decoder": list(settings.decoder),
            "norm_after_pool": settings.norm_after_pool,
        },
        "parity_error": error,
        "training": loaded.training,
        "scores": scores or {},
    }
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
    try:
        partial.chmod(0o755)
        (partial / "model.onnx").write_bytes(serialised)
        (partial / "model.json").write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")
        _exchange(partial, folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return load_bundle(folder), error


def _is_bundle(folder: Path) -> bool:
    return folder.is_dir() and {path.name for path in folder.iterdir()} <= {"model.onnx", "model.json"}


def _exchange(partial: Path, folder: Path) -> None:
    """Puts the new folder in the place of the old one, if there is one; when that fails the old one is put back."""
    if not folder.exists():
        partial.replace(folder)
        return
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as aside:
        old = folder.rename(Path(aside) / folder.name)
        try:
            partial.replace(folder)
        except BaseException:
            old.rename(folder)
            raise


def parity_error(loaded: Loaded, serialised: bytes) -> float:
    """Largest absolute difference between torch and onnxruntime, over real patches of several lengths and batches."""
    session = onnxruntime.InferenceSession(serialised, providers=["CPUExecutionProvider"])
    largest = 0.0
    for length in (1, 7, loaded.patch_points // 2, loaded.patch_points):
        patches = _patches(length)
        with torch.inference_mode():
            expected = loaded.network(torch.from_numpy(patches)).numpy()
        (answer,) = session.run(None, {"patches": patches})
        largest = max(largest, float(np.abs(answer - expected).max()))
    return largest


def _patches(length: int, count: int = 64) -> NDArray[np.float32]:
    """Patches of a rippled, noisy sheet: flat, curved and ragged ones."""
    rng = np.random.default_rng(length)
    xy = rng.uniform(-1, 1, (4000, 2))
    points = np.column_stack([xy, 0.1 * np.sin(8 * xy[:, 0]) * np.abs(xy[:, 1]) + rng.normal(scale=0.01, size=4000)])
    ids = stable_ids(points)
    index = NeighbourIndex(points, 0.2, ids)
    return index.patches(points[:count], ids[:count], length, key=0).points
