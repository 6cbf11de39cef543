"""Hostile files lead to the documented error: fast, in little memory, with a message that is safe to print."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.attacks.files import ATTACKS, Attack

SECONDS = 2.0
MESSAGE = 400  # characters


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    if sys.platform != "linux":
        pytest.skip("needs RLIMIT_AS")
    done = subprocess.run(
        [sys.executable, "-W", "error", "-m", "tests.attacks.run", str(tmp_path_factory.mktemp("attacks"))],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[2],
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_every_attack_has_a_name_of_its_own() -> None:
    assert len({attack.name for attack in ATTACKS}) == len(ATTACKS)


@pytest.mark.parametrize("attack", ATTACKS, ids=lambda attack: attack.name)
def test_attack(attack: Attack, results: dict[str, Any]) -> None:
    result = results[attack.name]
    expected = attack.error.__name__ if attack.error else None
    assert result["error"] == expected, result["message"]
    assert result["seconds"] < SECONDS
    assert result["message"].isascii()
    assert result["message"] == "" or result["message"].isprintable()
    assert len(result["message"]) < MESSAGE
    assert result["written"] == (attack.error is None)
    assert result["left"] == []
