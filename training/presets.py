"""Presets are TOML files in configs/; anything they do not say is the settings classes' default."""

from __future__ import annotations

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

from training.train import TrainingSettings

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
            values[key] = value
