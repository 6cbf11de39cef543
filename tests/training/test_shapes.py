from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from training.shapes import KINDS, Mesh, kinds, level_sets, organic, random_shape, scenes, sheets
from training.shapes.csg import solid_of


def check(mesh: Mesh) -> None:
    """Diagonal 1 over the vertices in use, faces with an area, unit corner normals that agree with the faces."""
    used = mesh.vertices[np.unique(mesh.faces)]
    assert np.linalg.norm(np.ptp(used, axis=0)) == pytest.approx(1, abs=1e-6)
    corners = mesh.vertices[mesh.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(cross, axis=1)
    assert areas.min() > 0
    np.testing.assert_allclose(np.linalg.norm(mesh.corner_normals, axis=2), 1, atol=1e-6)
    agreement = np.einsum("fd,fd->f", cross, mesh.corner_normals.mean(axis=1)).sum() / areas.sum()
    assert agreement > 0.8


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_every_kind_gives_a_sound_mesh(kind: str, seed: int) -> None:
    mesh = KINDS[kind].build(np.random.default_rng(seed))
    assert mesh is not None
    check(mesh)
    again = KINDS[kind].build(np.random.default_rng(seed))
    assert again is not None
    np.testing.assert_array_equal(mesh.vertices, again.vertices)
    np.testing.assert_array_equal(mesh.faces, again.faces)
    np.testing.assert_array_equal(mesh.corner_normals, again.corner_normals)


@pytest.mark.parametrize("build", [scenes._standing, scenes._room, scenes._street])
def test_every_scene_gives_a_sound_mesh(build: kinds.Build) -> None:
    mesh = build(np.random.default_rng(0))
    assert mesh is not None
    check(mesh)


def test_seeds_draw_from_the_table_and_families_share_no_shape(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[str] = []

    def stand_in(kind: str) -> kinds.Build:
        def build(rng: np.random.Generator) -> Mesh | None:
            drawn.append(kind)
            return None if rng.random() < 0.1 else sheets.open_sheet(rng)

        return build

    monkeypatch.setattr(kinds, "KINDS", {name: kinds.Kind(kind.weight, stand_in(name)) for name, kind in KINDS.items()})
    meshes = [random_shape(seed) for seed in range(150)]
    assert set(drawn) == set(KINDS)
    share = drawn.count("detailed part") / len(drawn)
    assert share == pytest.approx(KINDS["detailed part"].weight, abs=0.1)
    other = random_shape(0, family=1)
    assert other.vertices.shape != meshes[0].vertices.shape or (other.vertices != meshes[0].vertices).any()


def test_marching_cubes_are_a_minor_share() -> None:
    total = sum(kind.weight for kind in KINDS.values())
    assert total == pytest.approx(1)
    assert sum(KINDS[name].weight for name in ("rounded solid", "smooth body", "organic")) <= 0.3 * total


def test_sums_of_waves_agree_on_the_grid_and_at_its_points() -> None:
    rng = np.random.default_rng(0)
    vectors, phases = rng.normal(size=(5, 3)) * 9, rng.uniform(0, 6, 5)
    field = organic._waves_on_grid(vectors, phases)
    rows = rng.integers(level_sets.RESOLUTION, size=(100, 3))
    places = tuple(rows.T)
    expected = organic._waves_at(level_sets.GRID[places])(vectors, phases)
    np.testing.assert_allclose(field[places], expected, atol=1e-9)


def test_parallel_sheets_keep_their_gap() -> None:
    gaps = []
    for seed in range(4):
        mesh = sheets.parallel_sheets(np.random.default_rng(seed))
        assert mesh is not None
        first = mesh.vertices[: 96 * 96]
        second = mesh.vertices[96 * 96 :]
        gaps.append(np.median(cKDTree(first).query(second)[0]))
    assert 0.002 < min(gaps) < max(gaps) < 0.19


def test_a_level_set_turns_into_a_solid() -> None:
    distance = np.linalg.norm(level_sets.GRID, axis=-1) - 0.5
    ball = level_sets.level_set(distance)
    assert ball is not None
    solid = solid_of(ball)
    radius = 0.5 / np.sqrt(3)
    assert solid.volume() == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.01)
