"""A short run of the fuzzer; CONTRIBUTING.md has the command for a long one."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def test_mutated_files_are_read_or_refused(tmp_path: Path) -> None:
    if not importlib.util.find_spec("atheris"):
        pytest.skip("atheris has no wheel for this Python or system")
    done = subprocess.run(
        [sys.executable, "-m", "tests.fuzz.ply", "-max_total_time=20", "-timeout=10", "-rss_limit_mb=1024"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "Done " in done.stderr
