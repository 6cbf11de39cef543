"""Checkpoint -> bundle: graph, parity check, model.json."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import torch
from numpy.typing import NDArray

from export.checkpoint import Loaded
from export.graph import OPSET, build, encoder_ranges
from pointfilter.filtering import MAX_ITERATIONS
from pointfilter.models import AUTO, FRAME, NAME, NAME_RULE, SCHEMA, Auto, ModelBundle, load_bundle
from pointfilter.patches import NeighbourIndex, stable_ids
from training.dataset import DataSettings, TrainingCloud, cut_batch, training_clouds

PARITY_TOLERANCE = 1e-5  # of the radius
ROUNDING_TOLERANCE = 0.05  # of the mean displacement: what int8 may change of it, on average
CALIBRATION_CLOUDS = 32
CALIBRATION_PATCHES = 2048
CALIBRATION_SEED = 77


class ParityError(RuntimeError):
    """torch and onnxruntime disagree, so nothing was exported."""


class RoundingError(RuntimeError):
    """int8 changes what the network answers by more than it may, so nothing was exported."""


def write_bundle(
    loaded: Loaded,
    folder: Path,
    version: str,
    iterations: int | Auto = AUTO,
    scores: dict[str, Any] | None = None,
    int8: bool = False,
) -> tuple[ModelBundle, float]:
    """Writes the bundle folder (its name is the model's name), whole or not at all but for the instant between two
    renames when it takes the place of an older one.

    int8: with the encoder's products in 8-bit integers, see graph.py. Returns the bundle as the service will load it,
    and the parity error (of the float32 graph). Raises ParityError above PARITY_TOLERANCE, RoundingError above
    ROUNDING_TOLERANCE, ValueError where the folder is there and is no bundle.
    """
    if iterations != AUTO and not 1 <= iterations <= MAX_ITERATIONS:
        raise ValueError(f"iterations must be from 1 to {MAX_ITERATIONS}, got {iterations}")
    folder = folder.resolve()
    for what, text in (("the folder's name", folder.name), ("the version", version)):
        if not NAME.fullmatch(text):
            raise ValueError(f"{what} must be {NAME_RULE}, not {text!r}")
    if folder.exists() and not _is_bundle(folder):
        raise ValueError(f"{folder} is there and is no bundle: choose another name, nothing is overwritten")
    serialised = build(loaded.network).SerializeToString()
    error = parity_error(loaded, serialised)
    if not error <= PARITY_TOLERANCE:
        raise ParityError(f"torch and onnxruntime differ by {error:.3g} of the radius, more than {PARITY_TOLERANCE:g}")
    rounding = 0.0
    if int8:
        serialised, rounding = _rounded(loaded, serialised)
        if not rounding <= ROUNDING_TOLERANCE:
            raise RoundingError(
                f"int8 changes displacements by {rounding:.3g} of their length, more than {ROUNDING_TOLERANCE:g}"
            )
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
        "precision": "int8" if int8 else "float32",
        "parity_error": error,
        "rounding_error": rounding,
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


def _rounded(loaded: Loaded, exact: bytes) -> tuple[bytes, float]:
    """The int8 graph, and by how much it changes displacements of other patches, as a share of their mean length."""
    calibration, others = (typical_patches(loaded.patch_points, step) for step in (0, 1))
    serialised = build(loaded.network, encoder_ranges(loaded.network, calibration)).SerializeToString()
    expected, answers = (
        onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"]).run(None, {"patches": others})[0]
        for graph in (exact, serialised)
    )
    lengths = np.linalg.norm(expected, axis=1)
    return serialised, float(np.linalg.norm(answers - expected, axis=1).mean() / max(lengths.mean(), 1e-12))


@cache
def _calibration_clouds() -> list[TrainingCloud]:
    """Clouds of every noise level and of densities that do not matter much here, so few points."""
    settings = DataSettings(
        clouds=CALIBRATION_CLOUDS, fewest_points=5_000, most_points=50_000, clean_points=5_000, seed=CALIBRATION_SEED
    )
    return list(training_clouds(settings))


def typical_patches(patch_points: int, step: int) -> NDArray[np.float32]:
    """CALIBRATION_PATCHES patches of procedural shapes at every noise level: (B, patch_points, 3); others a step."""
    clouds = _calibration_clouds()
    settings = DataSettings(
        batch=CALIBRATION_PATCHES, clouds_per_batch=CALIBRATION_CLOUDS, patch_points=patch_points, clean_patch_points=1
    )
    patches: NDArray[np.float32] = cut_batch(clouds, settings, step).patches.numpy()
    return patches


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
