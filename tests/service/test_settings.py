"""Settings: from the environment, checked, and documented."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import pytest
from pydantic import ValidationError

from pointfilter.engine import DEVICES
from service.settings import PREFIX, Settings, variable

DOCUMENT = Path(__file__).parents[2] / "docs" / "configuration.md"


@pytest.fixture(autouse=True)
def _empty_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in Settings.model_fields:
        monkeypatch.delenv(variable(name), raising=False)


def test_the_document_lists_every_knob_as_it_is() -> None:
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \| (.*?) \|$", DOCUMENT.read_text(encoding="utf-8"), re.MULTILINE)
    expected = []
    for name, field in Settings.model_fields.items():
        assert field.description, f"{name} has no docstring"
        default = "unset" if field.default is None else f"`{field.default}`"
        expected.append((variable(name), default, " ".join(field.description.split())))
    assert rows == expected


def test_every_device_of_the_library_may_be_asked_for() -> None:
    assert get_args(Settings.model_fields["device"].annotation) == ("auto", *DEVICES)


def test_the_environment_is_read(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("POINTFILTER_PORT", "9000")
    monkeypatch.setenv("POINTFILTER_MODEL_DIR", str(tmp_path))
    monkeypatch.setenv("POINTFILTER_MAX_POINTS", "5")
    monkeypatch.setenv("POINTFILTER_QUEUE_SIZE", "")
    settings = Settings()
    assert (settings.port, settings.model_dir, settings.queue_size) == (9000, tmp_path, 8)
    assert settings.read_limits.max_points == 5
    assert settings.read_limits.max_points_knob == "POINTFILTER_MAX_POINTS"


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("PORT", "70000"),
        ("WORKERS", "0"),
        ("QUEUE_SIZE", "-1"),
        ("MAX_UPLOAD_BYTES", "512MB"),
        ("MAX_ITERATIONS", "101"),
        ("TIMEOUT_SECONDS", "0"),
        ("DEVICE", "tpu"),
        ("LOG_FORMAT", "xml"),
    ],
)
def test_nonsense_is_refused(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    monkeypatch.setenv(PREFIX + name, value)
    with pytest.raises(ValidationError):
        Settings()
