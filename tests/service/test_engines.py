"""Models in memory."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from pointfilter.errors import InvalidModelError, ModelNotFoundError
from service.engines import Engines
from service.settings import Settings
from tests.service.conftest import write_bundle


def test_a_model_is_loaded_once(make_settings: Callable[..., Settings]) -> None:
    engines = Engines(make_settings())
    with ThreadPoolExecutor(8) as pool:
        found = set(pool.map(lambda _: id(engines.engine("tiny")), range(32)))
    assert len(found) == 1
    assert [engine.bundle.name for engine in engines.loaded()] == ["tiny"]


def test_the_one_used_longest_ago_makes_room_and_never_the_default(
    make_settings: Callable[..., Settings], tmp_path: Path
) -> None:
    for name in ("tiny", "a", "b", "c"):
        write_bundle(tmp_path / "many" / name)
    engines = Engines(make_settings(model_dir=tmp_path / "many", max_models=3))
    for name in ("tiny", "a", "b", "a", "c"):
        engines.engine(name)
    assert {engine.bundle.name for engine in engines.loaded()} == {"tiny", "a", "c"}


def test_unknown_and_damaged(make_settings: Callable[..., Settings]) -> None:
    engines = Engines(make_settings())
    with pytest.raises(ModelNotFoundError):
        engines.engine("../tiny")
    with pytest.raises(InvalidModelError):
        engines.bundle("broken")
    assert engines.names()[0] == "tiny"


def test_threads_are_shared_among_the_workers(
    make_settings: Callable[..., Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.engines.available_cpus", lambda: 8)
    assert Engines(make_settings(threads=0, workers=3)).engine("tiny").threads == 2
    assert Engines(make_settings(threads=0, workers=100)).engine("tiny").threads == 1
    assert Engines(make_settings(threads=5, workers=3)).engine("tiny").threads == 5
