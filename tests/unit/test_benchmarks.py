"""The benchmarks' commands say what they are for; what they measure has tests of its own."""

from __future__ import annotations

from importlib import import_module

import pytest


@pytest.mark.parametrize("name", ["classics.tuning", "load", "pictures", "quality", "speed"])
def test_help_is_printed(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        import_module(f"benchmarks.{name}").main(["--help"])
    assert ended.value.code == 0
    assert f"usage: python -m benchmarks.{name.partition('.')[0]}" in capsys.readouterr().out
