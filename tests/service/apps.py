"""Looking into apps under test, and holding their work."""

from __future__ import annotations

import multiprocessing
import threading
import time
from collections.abc import Callable
from typing import Any

from fastapi import FastAPI
from starlette.testclient import TestClient

import service.work
from pointfilter import PointCloud
from pointfilter.errors import FilteringCancelledError
from service import worker
from service.hands import Hand
from service.house import House
from service.settings import Settings


class Gate:
    """Stands in for filter_cloud, or for look: requests stay inside until the gate opens or their work is stopped."""

    def __init__(self, name: str = "filter_cloud") -> None:
        self.open = threading.Event()
        self.entered = 0
        self.stopped = 0
        self._real = getattr(service.work, name)

    def __call__(self, cloud: PointCloud, engine: Any, *, cancelled: Callable[[], bool], **others: Any) -> Any:
        self.entered += 1
        while not self.open.wait(0.01):
            if cancelled():
                self.stopped += 1
                raise FilteringCancelledError("stopped")
        return self._real(cloud, engine, cancelled=cancelled, **others)


def until(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    """Waits for a condition; fails when it does not come true."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.01)


def house_of(client: TestClient) -> House:
    assert isinstance(client.app, FastAPI)
    house = client.app.state.house
    assert isinstance(house, House)
    return house


def metric(client: TestClient, name: str, **labels: str) -> float:
    """A sample's value; 0 for one that is not there yet."""
    return house_of(client).telemetry.registry.get_sample_value(name, labels) or 0.0


def start_thread(settings: Settings) -> Hand:
    """A worker in a thread of this process, in place of one in a process of its own. It cannot be killed."""
    ours, theirs = multiprocessing.Pipe()
    threading.Thread(target=worker.run, args=(theirs, settings), name="worker", daemon=True).start()
    return Hand(ours, lambda: None)
