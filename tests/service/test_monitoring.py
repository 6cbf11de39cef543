"""Alerts and dashboard: they name what is there, and the alerts go off when they should."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
import yaml
from starlette.testclient import TestClient

ROOT = Path(__file__).parents[2]
PROMETHEUS = ROOT / "docker" / "prometheus"
DASHBOARD = ROOT / "docker" / "grafana" / "dashboards" / "pointfilter.json"
OF_PROMETHEUS = {"up"}


def rules() -> list[dict[str, Any]]:
    groups = yaml.safe_load((PROMETHEUS / "alerts.yml").read_text(encoding="utf-8"))["groups"]
    return [rule for group in groups for rule in group["rules"]]


def panels() -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads(DASHBOARD.read_text(encoding="utf-8"))["panels"]
    return found


def queries() -> list[str]:
    return [rule["expr"] for rule in rules()] + [
        target["expr"] for panel in panels() for target in panel.get("targets", [])
    ]


def test_every_metric_that_is_asked_for_is_in_a_scrape(client: TestClient, ply: bytes) -> None:
    client.post("/filter", content=ply)
    job = client.post("/jobs", content=ply).headers["location"]
    assert client.get(f"{job}?wait=30").json()["state"] == "done"
    present = set(re.findall(r"^(\w+)", client.get("/metrics").text, re.MULTILINE))
    asked = {name for query in queries() for name in re.findall(r"\b(?:pointfilter|process|python)_\w+|\bup\b", query)}
    assert len(asked) > 10
    assert asked - present - OF_PROMETHEUS == set()


def test_every_alert_has_a_runbook_and_a_test() -> None:
    runbook = (ROOT / "docs" / "operations.md").read_text(encoding="utf-8")
    tested = (PROMETHEUS / "alerts_test.yml").read_text(encoding="utf-8")
    for rule in rules():
        name = rule["alert"]
        assert f"### {name}\n" in runbook
        assert rule["annotations"]["runbook"] == f"docs/operations.md#{name.lower()}"
        assert f"alertname: {name}\n" in tested


def test_the_alerts_go_off_when_they_should() -> None:
    if not shutil.which("promtool"):
        pytest.skip("no promtool on this machine (Debian: apt-get install prometheus)")
    for command in (["check", "config", "prometheus.yml"], ["test", "rules", "alerts_test.yml"]):
        done = subprocess.run(["promtool", *command], cwd=PROMETHEUS, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr


def test_panels_do_not_overlap_and_say_what_they_show() -> None:
    taken: set[tuple[int, int]] = set()
    for panel in panels():
        place = panel["gridPos"]
        cells = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert not cells & taken
        taken |= cells
        assert panel["title"]
        assert panel["type"] == "row" or (panel["description"] and panel["targets"])
    assert len({panel["id"] for panel in panels()}) == len(panels())
