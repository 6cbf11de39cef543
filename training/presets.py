"""Presets are TOML files in configs/; anything they do not say is the settings classes' default."""

from __future__ import annotations

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

from training.settings import TrainingSettings

CONFIGS = Path(__file__).parent / "configs"


def preset_names() -> list[str]:
    return sorted(path.stem for path in CONFIGS.glob("*.toml"))


def load_preset(name: str, overrides: list[str] | None = None) -> TrainingSettings:
    """The settings of a preset, changed by "key=value" overrides such as "data.clouds=20" (values are TOML).

    Raises ValueError for an unknown preset or key and for a value that is no TOML.
    """
    if name not in preset_names():
        raise ValueError(f"unknown preset {name!r}: choose from {', '.join(preset_names())}")
    values = dataclasses.asdict(TrainingSettings())
    _merge(values, tomllib.loads((CONFIGS / f"{name}.toml").read_text()), name)
    for override in overrides or []:
        try:
            _merge(values, tomllib.loads(override), override)
        except tomllib.TOMLDecodeError as error:
            raise ValueError(f"{override!r} is not KEY=VALUE with a TOML value: {error}") from None
    return TrainingSettings.from_dict(values)


def _merge(values: dict[str, Any], changes: dict[str, Any], source: str) -> None:
    for key, value in changes.items():
        if key not in values:
            raise ValueError(f"{source}: no setting {key!r}; known here: {', '.join(sorted(values))}")
        if isinstance(values[key], dict) and isinstance(value, dict):
            _merge(values[key], value, source)
        else:
            values[key] = _typed(key, values[key], value, source)


def _typed(key: str, old: Any, new: Any, source: str) -> Any:
    """The new value where it is of the old one's type; a whole number will do for a float."""
    if isinstance(old, float) and type(new) is int:
        return float(new)
    if isinstance(old, tuple | list):
        kind = type(old[0]) if old else float
        if isinstance(new, list) and all(type(entry) is kind for entry in new):
            return new
        raise ValueError(f"{source}: {key} must be a list of {kind.__name__}, not {new!r}")
    if type(new) is not type(old):
        raise ValueError(f"{source}: {key} must be of type {type(old).__name__}, not {new!r}")
    return new
