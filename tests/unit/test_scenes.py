"""The procedural scenes: the same points in every run, each on the part that its label names."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest

pytest.importorskip("trimesh", reason="the benchmarks extra is not installed")

from benchmarks.parts import part_table, verdict
from benchmarks.scenes import APART, FLOOR_POINTS, OBJECT_POINTS, ROOM_NOISE, SCANNER, SCENES, Part, Scene
from pointfilter.noise import bounding_box_diagonal


@functools.cache
def made(name: str) -> Scene:
    return SCENES[name]()


@pytest.mark.parametrize("name", SCENES)
def test_the_same_points_in_every_run(name: str) -> None:
    again = SCENES[name]()
    for field in ("clean", "noisy", "labels"):
        np.testing.assert_array_equal(getattr(again, field), getattr(made(name), field))


@pytest.mark.parametrize("name", SCENES)
def test_points_without_noise_lie_on_the_part_of_their_label(name: str) -> None:
    scene = made(name)
    assert scene.clean.shape == scene.noisy.shape == (len(scene.labels), 3)
    assert set(scene.labels) == set(range(len(scene.parts)))
    for label, part in enumerate(scene.parts):
        points = scene.clean[scene.labels == label]
        assert part.distances(points[:: max(1, len(points) // 500)]).max() < 1e-9 * max(part.size, np.abs(points).max())


def test_the_room_is_drawn_by_area_with_3_mm_of_noise() -> None:
    room = made("room")
    assert len(room.clean) == 150_000
    counts = dict(zip((part.name for part in room.parts), np.bincount(room.labels), strict=True))
    assert counts["walls"] / counts["floor"] == pytest.approx(48 / 16, rel=0.02)
    assert counts["table top"] / counts["floor"] == pytest.approx(1.6 * 0.9 / 16, rel=0.1)
    assert counts["legs"] / counts["floor"] == pytest.approx(4 * 4 * 0.06 * 0.72 / 16, rel=0.15)
    assert (room.noisy - room.clean).std() == pytest.approx(ROOM_NOISE, rel=0.01)
    heights = {part.name: part.vertices[:, 2].max() for part in room.parts}
    assert heights["table top"] - heights["underside"] == pytest.approx(0.03)
    assert room.rms(room.noisy) == pytest.approx([1000 * ROOM_NOISE] * len(room.parts), rel=0.15)


def test_the_street_is_seen_from_the_scanner() -> None:
    street = made("street")
    assert len(street.clean) == 300_000
    rays = street.clean - SCANNER
    along = np.einsum("ij,ij->i", street.noisy - street.clean, rays) / np.linalg.norm(rays, axis=1)
    np.testing.assert_allclose(np.abs(along), np.linalg.norm(street.noisy - street.clean, axis=1), atol=1e-9)
    ground = street.clean[(street.labels == 0) & (street.clean[:, 2] == 0)]
    near, far = (np.sum((np.abs(ground[:, 0]) > a) & (np.abs(ground[:, 0]) < a + 2)) for a in (4, 14))
    assert near > 5 * far
    names = [part.name for part in street.parts]
    for name in ("poles", "trunks"):  # their middles are at x = whole numbers and y = ±5.5; the far side is not seen
        points = street.clean[street.labels == names.index(name)]
        axes = np.column_stack([np.round(points[:, 0]), np.sign(points[:, 1]) * 5.5])
        sides = points[points[:, 2] < 2.0]
        towards = np.einsum("ij,ij->i", sides[:, :2] - axes[points[:, 2] < 2.0], SCANNER[:2] - sides[:, :2])
        assert (towards > -1e-9).all()


def test_noise_is_where_the_parts_say() -> None:
    on_floor = made("object on floor")
    moved = (on_floor.clean != on_floor.noisy).any(axis=1)
    assert [part.noisy for part in on_floor.parts] == [True, False]
    assert [moved[on_floor.labels == label].mean() for label in (0, 1)] == [1, 0]
    assert np.bincount(on_floor.labels).tolist() == [OBJECT_POINTS, FLOOR_POINTS]
    thing, floor = on_floor.parts
    assert np.ptp(floor.vertices[:, 0]) == pytest.approx(10 * np.ptp(thing.vertices[:, 0]))
    apart = made("two objects")
    first, second = (apart.clean[apart.labels == label] for label in (0, 1))
    distance = np.linalg.norm(first.mean(axis=0) - second.mean(axis=0))
    assert distance == pytest.approx(APART * bounding_box_diagonal(first), rel=0.01)


def test_rms_is_of_the_scene_s_unit() -> None:
    corners = np.array([[0, 0, 0], [3, 0, 0], [3, 4, 0], [0, 4, 0]], dtype=np.float64)
    part = Part("flat", corners, np.array([[0, 1, 2], [0, 2, 3]]))
    points = np.array([[1, 1, 0.3], [1, 1, -0.4]])
    scene = Scene("scene", "mm", (part,), points * [1, 1, 0], points, np.zeros(2, dtype=np.int64))
    rms = np.sqrt((0.3**2 + 0.4**2) / 2)
    assert scene.rms(points) == pytest.approx([1000 * rms])
    assert dataclasses.replace(scene, unit="% of size").rms(points) == pytest.approx([100 * rms / 5])


def test_a_part_without_noise_is_kept_or_worse() -> None:
    part = Part("part", np.zeros((3, 3)), np.zeros((1, 3), dtype=np.int64))
    clean = dataclasses.replace(part, noisy=False)
    assert [verdict(part, 2.0, after, 1.0) for after in (1.9, 2.0, 2.1)] == ["better", "worse", "worse"]
    assert [verdict(clean, 0.0, after, 1.0) for after in (0.0, 1.0, 1.1)] == ["kept", "kept", "worse"]


def test_the_table_counts_the_verdicts() -> None:
    row = {"scene": "room", "method": "ours", "points": 10, "moved": 0.5, "unit": "mm", "seconds": 1.0, "passes": 2}
    rows = [
        {**row, "part": "floor", "before": 3.0, "after": 1.5, "verdict": "better"},
        {**row, "part": "legs", "before": 3.0, "after": 6.0, "verdict": "worse"},
        {**row, "part": "clean", "before": 0.0, "after": 0.0, "verdict": "kept"},
    ]
    text = part_table(rows)
    assert text.endswith("parts: 1 better, 1 kept, 1 worse")
    assert "0.500" in next(line for line in text.splitlines() if "floor" in line)
    assert "2.000" in next(line for line in text.splitlines() if "legs" in line)
