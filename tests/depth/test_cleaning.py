"""Cleaned depth maps, compared with plain loops and with scenes of known depth."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from smartcam.depth import SpatialFilter, TemporalFilter, fill_holes
from smartcam.depth._cleaning import _join_neighbours, as_metres
from smartcam.depth._inside import FOCAL, TowerTable, WoodenBlock
from smartcam.depth._simulation import (
    BASELINE,
    DISPARITY_SIGMA,
    RAYS_PER_SIDE,
    _find_jumps,
    _TableRays,
)
from smartcam.exceptions import ConfigurationError, FrameFormatError

NEAR, FAR, SIGMA = 0.45, 0.50, 0.002

Map = NDArray[Any]


def step(shape: tuple[int, int] = (60, 80)) -> Map:
    """Return a wall with a box in front."""
    depth = np.full(shape, FAR, np.float32)
    depth[15:45, 20:60] = NEAR
    return depth


def noisy(truth: Map, seed: int, holes: float = 0.05) -> Map:
    random = np.random.default_rng(seed)
    depth: Map = (truth + random.normal(0, SIGMA, truth.shape)).astype(np.float32)
    depth[random.random(truth.shape) < holes] = 0
    return depth


def rms(depth: Map, truth: Map) -> float:
    there = depth > 0
    return math.sqrt(np.mean((depth[there] - truth[there]) ** 2))


# ---------------------------------------------------------------------- what a map is


def test_millimetres_become_metres() -> None:
    depth = np.array([[0, 1500], [65535, 1]], np.uint16)
    np.testing.assert_allclose(as_metres(depth), [[0, 1.5], [65.535, 0.001]], rtol=1e-6)
    np.testing.assert_allclose(as_metres(depth, 1e-4)[0, 1], 0.15, rtol=1e-6)


def test_invalid_depths_are_holes_and_the_given_map_is_unchanged() -> None:
    given = np.array([[math.nan, math.inf, -math.inf], [-1.0, 0.0, 2.5]])
    before = given.copy()
    depth = as_metres(given)
    assert depth.dtype == np.float32
    assert depth.tolist() == [[0, 0, 0], [0, 0, 2.5]]
    np.testing.assert_array_equal(given, before)


@pytest.mark.parametrize(
    "wrong",
    [np.zeros((2, 2), np.int32), np.zeros(4, np.uint16), np.zeros((2, 2, 1)), np.zeros((0, 4))],
)
def test_wrong_map_is_refused(wrong: Map) -> None:
    for stage in (SpatialFilter(), TemporalFilter(), fill_holes):
        with pytest.raises(FrameFormatError, match=r"expected \(H, W\) of uint16 or float, got"):
            stage(wrong)


@pytest.mark.parametrize("scale", [0.0, -1e-3, math.nan, math.inf])
def test_invalid_scale_is_refused(scale: float) -> None:
    with pytest.raises(ConfigurationError, match="scale: expected"):
        SpatialFilter()(np.ones((2, 2), np.uint16), scale)


# ---------------------------------------------------------------------- in space


def plain_pass(line: list[float], alpha: float, delta: float) -> None:
    """Smooth a line forwards and backwards, one number after the other."""
    for places in (range(1, len(line)), range(len(line) - 2, -1, -1)):
        way = 1 if places.step > 0 else -1
        for place in places:
            now, before = line[place], line[place - way]
            if now and before and abs(now - before) < delta:
                line[place] = alpha * now + (1 - alpha) * before


def plain_spatial(depth: Map, alpha: float, delta: float, iterations: int) -> Map:
    rows = depth.astype(float).tolist()
    for _ in range(iterations):
        for _ in range(2):
            for row in rows:
                plain_pass(row, alpha, delta)
            rows = [list(column) for column in zip(*rows, strict=True)]
    return np.array(rows)


@pytest.mark.parametrize(
    ("alpha", "delta", "iterations"), [(0.5, 0.02, 2), (0.25, 0.004, 1), (0.8, 0.1, 3)]
)
def test_spatial_filter_is_that_of_plain_loops(alpha: float, delta: float, iterations: int) -> None:
    depth = noisy(step((23, 31)) if delta > 0.05 else step()[8:31, 10:41], 1)
    smooth = SpatialFilter(alpha, delta, iterations)(depth)
    np.testing.assert_allclose(smooth, plain_spatial(depth, alpha, delta, iterations), atol=2e-6)


def test_spatial_filter_reduces_noise_and_keeps_edges() -> None:
    truth = step()
    depth = noisy(truth, 2)
    smooth = SpatialFilter(0.5, 0.02)(depth)
    assert rms(smooth, truth) < 0.35 * rms(depth, truth)
    there = smooth > 0
    # every pixel is on the side of the edge on which it was
    middle = (NEAR + FAR) / 2
    np.testing.assert_array_equal(smooth[there] < middle, truth[there] < middle)
    rim = there & (np.abs(truth - FAR) < 1e-6)
    rim[:, :18] = rim[:, 62:] = rim[:13] = rim[47:] = False  # two pixels around the box
    assert rms(np.where(rim, smooth, 0), truth) < rms(np.where(rim, depth, 0), truth)


def test_spatial_filter_without_edges_would_smear() -> None:
    truth = step()
    smeared = SpatialFilter(0.5, 1.0)(truth)
    kept = SpatialFilter(0.5, 0.02)(truth)
    np.testing.assert_allclose(kept, truth, atol=1e-6)
    assert np.abs(smeared - truth).max() > 0.01


def test_holes_stay_holes_and_have_no_part() -> None:
    truth = step()
    holes = np.random.default_rng(3).random(truth.shape) < 0.3
    depth = np.where(holes, 0, truth).astype(np.float32)
    # an edge of more than any depth: only a hole could drag
    smooth = SpatialFilter(0.3, 0.02, 4)(depth)
    np.testing.assert_array_equal(smooth == 0, holes)
    np.testing.assert_allclose(smooth[~holes], truth[~holes], atol=1e-6)
    near = np.where(holes, 0, np.float32(0.01))  # nearer than delta
    np.testing.assert_allclose(SpatialFilter(0.3, 0.02, 4)(near)[~holes], 0.01, atol=1e-7)


def test_slope_stays_a_slope_and_given_map_is_unchanged() -> None:
    slope = np.tile(np.linspace(0.4, 0.6, 200, dtype=np.float32), (50, 1))
    before = slope.copy()
    smooth = SpatialFilter(0.5, 0.02)(slope)
    np.testing.assert_allclose(smooth[:, 20:-20], slope[:, 20:-20], atol=2e-6)
    np.testing.assert_array_equal(slope, before)


def test_millimetres_are_smoothed_as_metres_are() -> None:
    depth = (1e3 * noisy(step(), 4)).astype(np.uint16)
    in_metres = SpatialFilter()(depth * np.float32(1e-3))
    np.testing.assert_allclose(SpatialFilter()(depth), in_metres, atol=1e-7)


def test_disparities_are_smoothed_in_pixels() -> None:
    truth = 30 / step()
    random = np.random.default_rng(5)
    smooth = SpatialFilter(0.5, delta=1.0)(truth + random.normal(0, 0.1, truth.shape))
    assert rms(smooth, truth) < 0.04


@pytest.mark.parametrize("iterations", [1, 2])
def test_shared_counts_pixels_with_common_noise(iterations: int) -> None:
    smooth = SpatialFilter(0.4, 1.0, iterations)
    depth = 5 + np.random.default_rng(6).normal(0, 1e-2, (400, 400))
    found = (1e-2 / np.std(smooth(depth)[30:-30, 30:-30])) ** 2
    assert smooth.correlated_pixels == pytest.approx(found, rel=0.1)
    assert SpatialFilter(1.0).correlated_pixels == pytest.approx(1.0)


@pytest.mark.parametrize(
    "wrong", [{"alpha": 0}, {"alpha": 1.1}, {"alpha": math.nan}, {"delta": 0}, {"delta": math.inf}]
)
def test_invalid_average_is_refused(wrong: dict[str, float]) -> None:
    for kind in (SpatialFilter, TemporalFilter):
        with pytest.raises(ConfigurationError, match=f"{kind.__name__}: (alpha|delta): expected"):
            kind(**wrong)  # type: ignore[arg-type]


def test_numbers_out_of_range_are_refused() -> None:
    for iterations in (0, 17):
        with pytest.raises(ConfigurationError, match="iterations: expected 1 to 16"):
            SpatialFilter(iterations=iterations)
    for persistence in (-1, 255):
        with pytest.raises(ConfigurationError, match="persistence: expected 0 to 254"):
            TemporalFilter(persistence=persistence)


# ---------------------------------------------------------------------- a rendered scene


def crossings(depth: Map, level: float) -> Map:
    """Return the column where each row first goes below a level; NaN at a hole."""
    below = (depth > 0) & (depth < level)
    first = below.argmax(axis=1)
    before = depth[np.arange(len(depth)), first - 1]
    return np.where((before > 0) & below.any(axis=1), first.astype(float), np.nan)


def test_rendered_scene_gets_nearer_to_its_truth_and_keeps_its_edges() -> None:
    table = TowerTable(1)
    table._camera_error[:] = 0  # the camera is where it is said to be
    table.blocks.append(WoodenBlock(0.4, 0.0, 0.5, size=(0.12, 0.06, 0.04)))
    camera = (0.4, 0.0, 0.5)
    rays = _TableRays(camera)
    rays.draw(table.blocks[0])
    truth = rays.depth[RAYS_PER_SIDE // 2 :: RAYS_PER_SIDE, RAYS_PER_SIDE // 2 :: RAYS_PER_SIDE]
    average, smooth = TemporalFilter(delta=0.008), SpatialFilter(delta=0.008)
    maps = table.look(camera, 5).depth
    for one in maps:
        steady = average(one)
    clean = smooth(steady)
    raw = as_metres(maps[-1])
    errors = [rms(one[there], truth[there]) for one in (raw, steady, clean) for there in [one > 0]]
    flat = ~_join_neighbours(_join_neighbours(_find_jumps(truth), np.logical_or), np.logical_or)
    inner = [rms(np.where(flat, one, 0), truth) for one in (raw, steady, clean)]
    assert errors[0] > errors[1] > errors[2]
    assert inner[1] < 0.7 * inner[0]
    assert inner[2] < 0.25 * inner[0]
    assert np.count_nonzero(clean) >= np.count_nonzero(raw)
    # where the right side of the block is: there the second camera sees the table, too
    level = (camera[2] + truth.min()) / 2
    rows = truth[:, ::-1].min(axis=1) < level
    wanted = crossings(truth[rows, ::-1], level)
    found = crossings(clean[rows, ::-1], level)
    off = np.abs(found - wanted)
    assert np.count_nonzero(np.isfinite(off)) > 50
    assert np.nanpercentile(off, 95) <= 1


# ---------------------------------------------------------------------- in time


class PlainTemporal:
    """Filter one pixel after the other, as the filter's documentation says."""

    def __init__(self, alpha: float, delta: float, persistence: int) -> None:
        self.alpha, self.delta, self.persistence = alpha, delta, persistence
        self.average: dict[tuple[int, int], float] = {}
        self.since: dict[tuple[int, int], int] = {}

    def __call__(self, depth: Map) -> Map:
        changed = {
            place
            for place, value in np.ndenumerate(depth)
            if value and place in self.average and abs(value - self.average[place]) >= self.delta
        }
        shown = np.zeros(depth.shape)
        for place, value in np.ndenumerate(depth):
            old = self.average.get(place)
            if value:
                keep = old is not None and place not in changed
                new = old + self.alpha * (value - old) if keep and old is not None else value
                self.average[place], self.since[place] = float(new), 0
            elif old is not None:
                self.since[place] += 1
                beside = any(
                    (place[0] + y, place[1] + x) in changed for y in (-1, 0, 1) for x in (-1, 0, 1)
                )
                if beside or self.since[place] > self.persistence:
                    del self.average[place]
            shown[place] = self.average.get(place, 0.0)
        return shown


@pytest.mark.parametrize("persistence", [0, 2])
def test_temporal_filter_is_that_of_plain_loops(persistence: int) -> None:
    average, plain = (kind(0.4, 0.02, persistence) for kind in (TemporalFilter, PlainTemporal))
    truth = step((12, 15))
    truth[3:9, 4:11] = NEAR
    random = np.random.default_rng(7)
    for number in range(12):
        depth = noisy(truth, 100 + number, holes=0.3)
        moved = random.random(truth.shape) < 0.05
        depth[moved & (depth > 0)] += 0.1
        np.testing.assert_allclose(average(depth), plain(depth), atol=2e-6)


def test_temporal_filter_takes_noise_out() -> None:
    truth = step()
    average = TemporalFilter(alpha=0.2)
    first = noisy(truth, 0)
    for number in range(20):
        shown = average(noisy(truth, number))
    # of an exponential average alpha / (2 - alpha) of the variance is left
    assert rms(shown, truth) == pytest.approx(SIGMA * math.sqrt(0.2 / 1.8), rel=0.1)
    assert rms(first, truth) > 2.5 * rms(shown, truth)


def test_moving_object_is_shown_at_its_new_place() -> None:
    average = TemporalFilter()
    truth = step()
    for _ in range(5):
        average(truth)
    moved = np.roll(truth, 3, axis=1)
    np.testing.assert_array_equal(average(moved), moved)


def test_hole_keeps_earlier_average_for_persistence_maps() -> None:
    average = TemporalFilter(persistence=2)
    truth = step()
    average(truth)
    holes = truth.copy()
    holes[5:8, 5:8] = 0
    for _ in range(2):
        np.testing.assert_array_equal(average(holes), truth)
    for _ in range(2):
        np.testing.assert_array_equal(average(holes), holes)
    np.testing.assert_array_equal(average(truth), truth)


def test_hole_beside_a_moved_object_is_cleared() -> None:
    average = TemporalFilter(persistence=5)
    truth = step()
    average(truth)
    gone = np.full_like(truth, FAR)
    gone[20, 30] = 0  # within the box, which was taken away
    shown = average(gone)
    np.testing.assert_array_equal(shown, gone)


def test_other_scene_or_size_begins_anew() -> None:
    average = TemporalFilter(persistence=5)
    average(step())
    other = np.full((60, 80), 1.5, np.float32)
    other[:, ::4] = 0
    np.testing.assert_array_equal(average(other), other)  # no hole shows the old scene
    np.testing.assert_array_equal(average(step((30, 40))), step((30, 40)))
    average.reset()
    holes = np.zeros((30, 40), np.float32)
    np.testing.assert_array_equal(average(holes), holes)


def test_returned_average_is_a_copy() -> None:
    average = TemporalFilter()
    shown = average(step())
    shown[:] = 9
    again = average(step())
    again[:] = 9
    np.testing.assert_array_equal(average(step()), step())
    with pytest.raises(FrameFormatError):
        average(np.zeros((2, 2), int))
    np.testing.assert_array_equal(average(step()), step())


# ---------------------------------------------------------------------- holes


def plain_fill(depth: Map, how: str, reach: int) -> Map:
    now = depth.astype(float)
    for _ in range(reach):
        new = now.copy()
        for (y, x), value in np.ndenumerate(now):
            if value:
                continue
            if how == "left":
                new[y, x] = now[y, x - 1] if x else 0
                continue
            around = now[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2]
            there = around[around > 0]
            if there.size:
                new[y, x] = there.min() if how == "nearest" else there.max()
        now = new
    return now


@pytest.mark.parametrize("how", ["left", "nearest", "farthest"])
@pytest.mark.parametrize("reach", [1, 3])
def test_holes_are_filled_as_plain_loops_do(how: Any, reach: int) -> None:
    depth = noisy(step()[10:40, 10:40], 8, holes=0.6)
    depth[5:20, 4:16] = 0
    filled = fill_holes(depth, how, reach=reach)
    np.testing.assert_array_equal(filled, plain_fill(depth, how, reach).astype(np.float32))
    assert (filled[12, 10] == 0) == (reach < 6)  # it is bounded
    np.testing.assert_array_equal(filled[depth > 0], depth[depth > 0])


def test_nothing_to_fill_from_stays_empty() -> None:
    assert not fill_holes(np.zeros((4, 4), np.uint16), "nearest").any()


def test_unknown_way_of_filling_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"how: expected one of \('left', 'nearest'"):
        fill_holes(step(), "right")  # type: ignore[arg-type]
    for reach in (0, 17):
        with pytest.raises(ConfigurationError, match="reach: expected 1 to 16"):
            fill_holes(step(), reach=reach)


def test_simulated_depth_has_documented_noise_and_holes() -> None:
    table = TowerTable(4)
    table.blocks.append(WoodenBlock(0.4, 0.0, math.pi / 2, size=(0.2, 0.1, 0.06)))
    (depth,) = table.look((0.4, 0.0, 0.6)).depth
    for region, true in ((np.s_[10:60, 10:630], 0.6), (np.s_[200:280, 250:390], 0.54)):
        there = depth[region][depth[region] > 0] * 1e-3
        sigma = math.hypot(true**2 / (FOCAL * BASELINE) * DISPARITY_SIGMA, 1e-3 / math.sqrt(12))
        assert there.mean() == pytest.approx(true, abs=1e-3)  # the camera is not quite there
        assert there.std() == pytest.approx(sigma, rel=0.05)
        assert 0.003 < (depth[region] == 0).mean() < 0.02
    # the second camera does not see what the block hides: to its left
    shadow = FOCAL * BASELINE * (1 / 0.54 - 1 / 0.6)
    empty = (depth[200:280] == 0).mean(axis=0)
    assert np.count_nonzero(empty > 0.9) == pytest.approx(shadow, abs=1.5)
    assert np.flatnonzero(empty > 0.9).max() < 320
