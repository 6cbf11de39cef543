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
from numpy.typing import NDArray

from export.calibration import calibrate
from export.checkpoint import Loaded
from export.graph import OPSET, build, encoder_ranges, graph_network
from pointfilter.models import FRAME, NAME, NAME_RULE, SCHEMA, ModelBundle, load_bundle
from training.dataset import Batch, DataSettings, TrainingCloud, cut_batch
from training.own import as_network
from training.pools import Pools

PARITY_TOLERANCE = 1e-5  # of the radius
ROUNDING_TOLERANCE = 0.05  # of the mean displacement: what int8 may change of it, on average
CALIBRATION_CLOUDS = 32
CALIBRATION_PATCHES = 2048
CALIBRATION_SEED = 77
PARITY_PATCHES = 64


class ParityError(RuntimeError):
    """torch and onnxruntime disagree, so nothing was exported."""


class RoundingError(RuntimeError):
    """int8 changes what the network answers by more than it may, so nothing was exported."""


def write_bundle(
    loaded: Loaded,
    folder: Path,
    version: str,
    scores: dict[str, Any] | None = None,
    int8: bool = False,
) -> tuple[ModelBundle, float]:
    """Writes the bundle folder (its name is the model's name), whole or not at all but for the instant between two
    renames when it takes the place of an older one.

    int8: with the encoder's products in 8-bit integers, see graph.py. Returns the bundle as the service will load it,
    and the parity error (of the float32 graph). Raises ParityError above PARITY_TOLERANCE, RoundingError above
    ROUNDING_TOLERANCE, ValueError where the folder is there and is no bundle.
    """
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
        "parameters": sum(parameter.numel() for parameter in loaded.network.parameters()),
        "network": {
            "encoder": list(settings.encoder),
            "decoder": list(settings.decoder),
            "norm_after_pool": settings.norm_after_pool,
            "adaptive": settings.adaptive,
        },
        "calibration": calibrate(serialised, loaded.patch_points).as_dict() if settings.adaptive else None,
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
    ranges = encoder_ranges(loaded.network, typical_batch(loaded.patch_points, 0).patches.numpy())
    serialised = build(loaded.network, ranges).SerializeToString()
    others = _asked(typical_batch(loaded.patch_points, 1))
    expected, answers = (graph_network(graph)(*others).displacements for graph in (exact, serialised))
    lengths = np.linalg.norm(expected, axis=1)
    return serialised, float(np.linalg.norm(answers - expected, axis=1).mean() / max(lengths.mean(), 1e-12))


def _asked(batch: Batch) -> tuple[NDArray[Any], ...]:
    """What a network is called with."""
    return tuple(tensor.numpy() for tensor in (batch.patches, batch.context, batch.queries, batch.owners))


@cache
def _calibration_clouds() -> list[TrainingCloud]:
    """Clouds of every noise level and of densities that do not matter much here, so few points."""
    settings = DataSettings(
        clouds=CALIBRATION_CLOUDS, fewest_points=5_000, most_points=50_000, clean_points=5_000, seed=CALIBRATION_SEED
    )
    return Pools(settings)(0)


def typical_batch(patch_points: int, step: int, patches: int = CALIBRATION_PATCHES) -> Batch:
    """Patches of procedural shapes at every noise level; others a step."""
    settings = DataSettings(batch=patches, clouds_per_batch=CALIBRATION_CLOUDS, patch_points=patch_points)
    return cut_batch(_calibration_clouds(), settings, step)


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
    """Largest difference between the answers of torch and onnxruntime, over real patches of several lengths and
    batches: that of displacements, or of log_errors and normals relative to their size where it is above 1."""
    network = graph_network(serialised)
    differences = []
    for length in (1, 7, loaded.patch_points // 2, loaded.patch_points):
        asked = _asked(typical_batch(length, 2, PARITY_PATCHES))
        for found, expected in zip(network(*asked), as_network(loaded.network)(*asked), strict=True):
            if found is not None and expected is not None:
                differences.append((np.abs(found - expected) / np.maximum(np.abs(expected), 1)).max())
    return float(np.max(differences))  # NaN where any answer is
