from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from pointfilter import filter as filter_module
from pointfilter import network as network_module
from pointfilter.errors import (
    DegenerateCloudError,
    FilteringCancelledError,
    InvalidModelError,
    ParameterError,
    TooFewPointsError,
)
from pointfilter.filter import resolve_radius
from pointfilter.network import MIN_NEIGHBOURS
from pointfilter.patches import NeighbourIndex, sampling_key
from tests.clouds import filter_points, paper_network, pooled, pooled_displacements, still


@paper_network
def upwards(patches: np.ndarray) -> np.ndarray:
    """Half a radius along the z axis of every patch's frame."""
    return np.tile(np.array([0, 0, 0.5], np.float32), (len(patches), 1))


def test_a_point_moves_by_the_networks_answer_turned_back_and_scaled() -> None:
    """Eq. 8: on a plane, z of every frame is the plane's normal."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(size=(400, 2)), np.zeros(400)])
    filtered = filter_points(points, upwards, radius=0.2, iterations=1)
    np.testing.assert_allclose(np.abs(filtered[:, 2]), 0.1, rtol=1e-6)
    np.testing.assert_allclose(filtered[:, :2], points[:, :2], atol=1e-9)


def test_the_paper_s_equation_row_by_row(noisy_crease: np.ndarray) -> None:
    radius, offset = 0.15, (noisy_crease.min(axis=0) + noisy_crease.max(axis=0)) / 2
    points = noisy_crease - offset
    rows = np.arange(len(points))
    patches = NeighbourIndex(points, radius).patches(rows, np.full(len(rows), radius), 30, sampling_key(4, 0))
    answers = pooled_displacements(patches.points).astype(np.float64)
    expected = noisy_crease + radius * np.stack(
        [np.linalg.inv(frame) @ answer for frame, answer in zip(patches.frames, answers, strict=True)]
    )
    filtered = filter_points(noisy_crease, pooled, radius=radius, iterations=1, patch_points=30, seed=4)
    np.testing.assert_allclose(filtered, expected, atol=1e-12)


def test_points_with_too_few_neighbours_stay_put() -> None:
    rng = np.random.default_rng(0)
    crowd = 0.1 * rng.normal(size=(50, 3))
    three = np.array([[9.0, 9, 9], [9.1, 9, 9], [9, 9.1, 9]])
    filtered = filter_points(np.vstack([crowd, three]), upwards, radius=1.0, iterations=1)
    np.testing.assert_array_equal(filtered[50:], three)
    assert (filtered[:50] != crowd).any(axis=1).all()


def test_enough_neighbours_are_enough() -> None:
    points = np.random.default_rng(0).uniform(size=(MIN_NEIGHBOURS, 3))
    radius = 0.99 * float(np.linalg.norm(np.ptp(points, axis=0)))  # everybody is everybody's neighbour
    filtered = filter_points(points, upwards, radius=radius, iterations=1)
    np.testing.assert_allclose(np.linalg.norm(filtered - points, axis=1), radius / 2, rtol=1e-6)


def test_the_input_is_left_alone(noisy_crease: np.ndarray) -> None:
    before = noisy_crease.copy()
    filtered = filter_points(noisy_crease, pooled, radius=0.15)
    np.testing.assert_array_equal(noisy_crease, before)
    assert filtered.dtype == np.float64
    assert filtered.shape == before.shape


def test_a_network_that_stands_still_changes_nothing(noisy_crease: np.ndarray) -> None:
    np.testing.assert_array_equal(filter_points(1e6 + noisy_crease, still), 1e6 + noisy_crease)


def test_large_coordinates_keep_their_millimetres(noisy_crease: np.ndarray) -> None:
    """A scan in UTM metres moves as the same scan around the origin does, to a hundredth of a millimetre."""
    shift = np.array([498_765.0, 5_412_345.0, 312.0])
    here = filter_points(noisy_crease, pooled, radius=0.15, patch_points=30)
    there = filter_points(noisy_crease + shift, pooled, radius=0.15, patch_points=30)
    np.testing.assert_allclose(there - shift, here, rtol=0, atol=1e-5)


def test_every_iteration_works_on_the_points_of_the_one_before(noisy_crease: np.ndarray) -> None:
    """Two iterations are one and then another on its result: new neighbours, new frames, the same radius."""
    once = filter_points(noisy_crease, pooled, radius=0.15, iterations=1, patch_points=600)
    again = filter_points(once, pooled, radius=0.15, iterations=1, patch_points=600)
    twice = filter_points(noisy_crease, pooled, radius=0.15, iterations=2, patch_points=600)
    np.testing.assert_allclose(twice, again, atol=1e-6)
    assert np.abs(twice - once).max() > 1e-3


def test_the_radius_of_the_paper_s_mode_is_taken_once_from_the_input(noisy_crease: np.ndarray) -> None:
    diagonal = np.linalg.norm(np.ptp(noisy_crease, axis=0))
    assert resolve_radius(noisy_crease, None) == pytest.approx(0.05 * diagonal)
    assert resolve_radius(noisy_crease, None, 0.2) == pytest.approx(0.2 * diagonal)
    result = filter_module.filter_points(noisy_crease, pooled, iterations=3)
    np.testing.assert_array_equal(result.radii, resolve_radius(noisy_crease, None))
    assert result.passes == 3
    assert filter_module.filter_points(noisy_crease, pooled).passes == filter_module.DEFAULT_ITERATIONS


def test_each_iteration_draws_anew(noisy_crease: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    keys = []
    real = filter_module.sampling_key
    monkeypatch.setattr(
        filter_module, "sampling_key", lambda seed, iteration: keys.append(real(seed, iteration)) or keys[-1]
    )
    filter_points(noisy_crease, still, radius=0.1, iterations=3, seed=5)
    assert len(keys) == len(set(keys)) == 3


def test_every_pass_is_seen(noisy_crease: np.ndarray) -> None:
    seen: dict[int, np.ndarray] = {}
    filter_points(noisy_crease, pooled, radius=0.15, iterations=3, after_pass=seen.__setitem__)
    assert list(seen) == [1, 2, 3]
    for passes, points in seen.items():
        np.testing.assert_array_equal(points, filter_points(noisy_crease, pooled, radius=0.15, iterations=passes))


@pytest.mark.parametrize("count", range(MIN_NEIGHBOURS))
def test_too_few_points(count: int) -> None:
    with pytest.raises(TooFewPointsError, match=f"at least {MIN_NEIGHBOURS} .* has {count}"):
        filter_points(np.random.default_rng(0).normal(size=(count, 3)), pooled)


def test_no_extent_to_take_a_radius_from() -> None:
    points = np.ones((50, 3))
    with pytest.raises(DegenerateCloudError, match="pass radius"):
        filter_points(points, pooled)
    assert np.isfinite(filter_points(points, pooled, radius=1.0)).all()


@pytest.mark.parametrize("radius", [None, 1.0])
def test_an_extent_beyond_doubles(radius: float | None) -> None:
    with pytest.raises(DegenerateCloudError, match="precision"):
        filter_points(np.random.default_rng(0).uniform(-1, 1, (50, 3)) * 1e308, pooled, radius=radius)


@pytest.mark.parametrize("radius", [None, 1e300])
def test_coordinates_at_the_end_of_the_doubles(radius: float | None) -> None:
    """The middle of the box is not half of a sum that overflows."""
    points = 1.7e308 + np.zeros((50, 3))
    points[::2, 0] = np.nextafter(1.7e308, 0)
    with pytest.raises(DegenerateCloudError):
        filter_points(points, pooled, radius=radius)


def test_a_high_place_with_a_small_extent() -> None:
    rng = np.random.default_rng(0)
    points = 1e150 + 1e140 * rng.normal(size=(50, 3))
    assert np.isfinite(filter_points(points, pooled)).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("iterations", 0), ("iterations", -1), ("iterations", 101), ("seed", -1), ("seed", 2**63),
        ("radius", 0.0), ("radius", -1.0), ("radius", float("nan")), ("radius", float("inf")),
        ("patch_points", 0), ("threads", 0),
    ],
)  # fmt: skip
def test_parameters_out_of_range_are_named(name: str, value: float, noisy_crease: np.ndarray) -> None:
    with pytest.raises(ParameterError, match=name):
        filter_points(noisy_crease, pooled, **{name: value})


def test_points_that_are_none() -> None:
    with pytest.raises(ValueError, match="shape"):
        filter_points(np.zeros((9, 2)), pooled)
    with pytest.raises(ParameterError, match="finite"):
        filter_points(np.full((9, 3), np.nan), pooled)


def test_any_floats_will_do(noisy_crease: np.ndarray) -> None:
    single = noisy_crease.astype(np.float32)
    np.testing.assert_array_equal(
        filter_points(single, pooled, radius=0.15), filter_points(single.astype(np.float64), pooled, radius=0.15)
    )
    backwards = np.asfortranarray(noisy_crease[::-1])
    np.testing.assert_array_equal(
        filter_points(backwards, pooled, radius=0.15)[::-1], filter_points(noisy_crease, pooled, radius=0.15)
    )


# --- progress, cancellation, errors in the network ---


@pytest.mark.parametrize("threads", [1, 3])
def test_progress_only_rises_and_ends_at_the_total(
    threads: int, noisy_crease: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(network_module, "ROWS_PER_BATCH", 500)
    calls: list[tuple[int, int]] = []
    callers = set()

    def progress(done: int, total: int) -> None:
        calls.append((done, total))
        callers.add(threading.get_ident())

    filter_points(noisy_crease, pooled, iterations=3, threads=threads, progress=progress)
    done = [call[0] for call in calls]
    assert done == sorted(done)
    assert done[0] == 0
    assert done[-1] == 3 * len(noisy_crease)
    assert {call[1] for call in calls} == {3 * len(noisy_crease)}
    assert len(calls) > 6
    assert callers == {threading.get_ident()}


def test_progress_comes_while_the_work_goes_on(noisy_crease: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network_module, "ROWS_PER_BATCH", 500)
    evaluated = 0
    seen: set[int] = set()

    @paper_network
    def counted(patches: np.ndarray) -> np.ndarray:
        nonlocal evaluated
        evaluated += len(patches)
        return pooled_displacements(patches)

    filter_points(noisy_crease, counted, iterations=1, progress=lambda _done, _total: seen.add(evaluated))
    assert len(seen - {0, len(noisy_crease)}) > 3


@pytest.mark.parametrize("threads", [1, 3])
def test_cancellation_stops_after_the_batches_under_way(
    threads: int, noisy_crease: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(network_module, "ROWS_PER_BATCH", 1)
    evaluated = 0
    lock = threading.Lock()
    stop = threading.Event()

    @paper_network
    def predict(patches: np.ndarray) -> np.ndarray:
        nonlocal evaluated
        with lock:
            evaluated += 1
            if evaluated >= 10:
                stop.set()
        return pooled_displacements(patches)

    with pytest.raises(FilteringCancelledError):
        filter_points(noisy_crease, predict, threads=threads, cancelled=stop.is_set)
    assert evaluated <= 10 + 4 * threads


def test_nothing_is_left_running_after_a_cancellation(noisy_crease: np.ndarray) -> None:
    before = threading.active_count()
    with pytest.raises(FilteringCancelledError):
        filter_points(noisy_crease, pooled, threads=4, cancelled=lambda: True)
    assert threading.active_count() == before


def test_an_error_in_the_network_comes_out_as_it_is(noisy_crease: np.ndarray) -> None:
    @paper_network
    def broken(patches: np.ndarray) -> np.ndarray:
        raise RuntimeError("out of order")

    with pytest.raises(RuntimeError, match="out of order"):
        filter_points(noisy_crease, broken, threads=2)


def test_seconds_are_added_up_by_stage(noisy_crease: np.ndarray) -> None:
    @paper_network
    def slow(patches: np.ndarray) -> np.ndarray:
        time.sleep(0.01)
        return np.zeros((len(patches), 3), np.float32)

    seconds = filter_module.filter_points(noisy_crease, slow, iterations=2).seconds
    assert tuple(seconds) == filter_module.STAGES
    assert seconds["infer"] >= 0.02
    assert seconds["index"] > 0
    assert seconds["patches"] > 0
    assert seconds["balls"] == 0


# --- radii that make no sense ---


@pytest.mark.parametrize("radius", [1e-200, 5e-324, 1e6, 1e308])
def test_a_radius_far_from_the_cloud_s_size(radius: float, noisy_crease: np.ndarray) -> None:
    with pytest.raises(ParameterError, match="radius"):
        filter_points(noisy_crease, pooled, radius=radius)


def test_a_cloud_too_small_to_compute_with(noisy_crease: np.ndarray) -> None:
    with pytest.raises(DegenerateCloudError, match="same place"):
        filter_points(noisy_crease * 1e-162, pooled)


@pytest.mark.parametrize("answer", [np.nan, np.inf])
def test_a_network_that_answers_nonsense_is_an_error(answer: float, noisy_crease: np.ndarray) -> None:
    with pytest.raises(InvalidModelError, match="finite"):
        filter_points(
            noisy_crease, paper_network(lambda patches: np.full((len(patches), 3), answer, np.float32)), radius=0.15
        )


def test_points_at_one_place_say_nothing_about_a_surface() -> None:
    points = np.repeat([[1.0, 2.0, 3.0]], 1000, axis=0)
    np.testing.assert_array_equal(filter_points(points, upwards, radius=0.5), points)
