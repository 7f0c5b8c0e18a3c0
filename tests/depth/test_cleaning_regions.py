"""Median and sigma of a region, and its equalized picture."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from smartcam.depth import SpatialFilter, equalize_depth, region_depth
from smartcam.depth._regions import _polygon_mask
from smartcam.exceptions import ConfigurationError, FrameFormatError

Map = NDArray[Any]


def test_median_of_a_box_leaves_holes_and_the_rest_out() -> None:
    depth = np.full((20, 30), 9.0)
    depth[5:10, 4:14] = 0.5
    depth[6, 4:14] = 0
    depth[7, 5] = 3.0  # one wild pixel
    told = region_depth(depth, (4, 5, 10, 5))
    assert (told.median, told.count, told.pixels) == (0.5, 40, 50)
    assert told.spread == told.sigma == 0.0


def test_region_may_be_a_polygon_a_mask_or_all_of_it() -> None:
    depth = np.full((40, 40), 800, np.uint16)
    mask = np.zeros((40, 40), bool)
    mask[10:20, 5:25] = True
    depth[mask] = 400
    corners = [(4.5, 9.5), (24.5, 9.5), (24.5, 19.5), (4.5, 19.5)]
    for region in (mask, corners, np.array(corners), (5, 10, 20, 10)):
        told = region_depth(depth, region)
        assert told.median == pytest.approx(0.4)
        assert (told.count, told.pixels) == (200, 200)
    assert region_depth(depth).median == pytest.approx(0.8)
    assert region_depth(depth, mask, scale=1e-4).median == pytest.approx(0.04)


def test_region_is_clipped_to_the_map() -> None:
    depth = np.full((10, 10), 2.0)
    assert region_depth(depth, (-5, -5, 10, 10)).pixels == 25
    assert region_depth(depth, [(-9, -9), (4.5, -9), (4.5, 4.5), (-9, 4.5)]).pixels == 25


def test_polygon_has_the_pixels_with_centres_inside() -> None:
    random = np.random.default_rng(1)
    for _ in range(6):
        corners = random.uniform(-3, 23, (int(random.integers(3, 8)), 2))
        found = _polygon_mask(corners, (20, 18))
        for (y, x), inside in np.ndenumerate(found):
            # by the angle under which the corners are seen: a turn for each time around
            rays = corners - (x, y)
            angles = np.arctan2(rays[:, 1], rays[:, 0])
            turns = np.remainder(np.diff(np.append(angles, angles[0])) + np.pi, 2 * np.pi) - np.pi
            assert inside == bool(round(turns.sum() / (2 * np.pi)) % 2)


@pytest.mark.long
@pytest.mark.parametrize(
    ("smoothed", "holes", "most"), [(0, 0.05, 0.1), (1, 0, 0.1), (2, 0.05, 0.3)]
)
def test_sigma_equals_the_scatter_of_the_median(smoothed: int, holes: float, most: float) -> None:
    random = np.random.default_rng(2)
    smooth = SpatialFilter(0.5, 1.0, max(1, smoothed))
    medians, sigmas = [], []
    for _ in range(400):
        depth: Map = 0.5 + random.normal(0, 0.002, (50, 70))
        depth[random.random(depth.shape) < holes] = 0
        correlated_pixels = 1.0
        if smoothed:
            depth, correlated_pixels = smooth(depth), smooth.correlated_pixels
        told = region_depth(depth, (5, 5, 60, 40), correlated_pixels=correlated_pixels)
        medians.append(told.median)
        sigmas.append(told.sigma)
    assert 0.9 < np.mean(sigmas) / np.std(medians) < 1 + most


def test_spread_is_that_of_a_pixel_and_sigma_that_of_a_median() -> None:
    depth = 0.5 + np.random.default_rng(2).normal(0, 0.002, (100, 100))
    told = region_depth(depth)
    assert told.spread == pytest.approx(0.002, rel=0.05)
    assert told.sigma == pytest.approx(told.spread * math.sqrt(math.pi / 2) / 100)
    assert region_depth(depth, correlated_pixels=100).sigma == pytest.approx(
        told.spread / 10, rel=0.01
    )
    assert region_depth(depth, correlated_pixels=1e9).sigma == told.spread


def test_region_without_a_depth_is_refused_with_its_place() -> None:
    depth = np.full((20, 30), 1.0)
    depth[5:10, 4:14] = 0
    with pytest.raises(FrameFormatError, match=r"the box \[4, 5, 10, 5\], got none in 50 pixels"):
        region_depth(depth, (4, 5, 10, 5))
    with pytest.raises(FrameFormatError, match="got none in 0 pixels"):
        region_depth(depth, (100, 100, 5, 5))


@pytest.mark.parametrize(
    "wrong",
    [
        (1, 2, 3),
        (1, 2, 0, 4),
        (1.5, 2, 3, 4),
        [(1, 2), (3, 4)],
        [(1, 2), (3, 4), (5,)],
        [(0, 0), (5, 0), (math.nan, 5)],
        np.zeros((3, 3), bool),
        "left",
    ],
)
def test_wrong_region_is_refused(wrong: Any) -> None:
    for take in (region_depth, equalize_depth):
        with pytest.raises(ConfigurationError, match=r"region: expected a box"):
            take(np.ones((20, 20)), wrong)


def test_shared_below_one_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="correlated_pixels: expected 1 or more"):
        region_depth(np.ones((4, 4)), correlated_pixels=0.5)


# ---------------------------------------------------------------------- equalized


def test_equalized_region_shows_a_centimetre_in_a_room() -> None:
    depth = np.full((60, 80), 4.0, np.float32)
    depth[10:50, 10:40] = 0.40
    depth[10:50, 40:70] = 0.41
    depth[20, 20] = 0
    picture = equalize_depth(depth, (10, 10, 60, 40))
    assert picture.shape == (40, 60)
    assert picture.dtype == np.uint8
    assert (picture[0, 0], picture[0, -1], picture[10, 10]) == (255, 1, 0)


def test_equalized_greys_have_as_many_pixels_each() -> None:
    random = np.random.default_rng(3)
    depth = random.exponential(1.0, (128, 255)) + 0.1
    picture = equalize_depth(depth)
    counts = np.bincount(picture.ravel(), minlength=256)[1:]
    assert counts[1:-1].min() > 100
    assert counts[1:-1].max() < 150
    order = np.argsort(depth, axis=None)  # the nearer, the brighter
    assert (np.diff(picture.ravel()[order].astype(int)) <= 0).all()


def test_equalized_polygon_is_black_around_and_one_depth_is_white() -> None:
    picture = equalize_depth(np.ones((40, 40)), [(10, 5), (30, 20), (10, 35)])
    assert set(np.unique(picture)) == {0, 255}
    assert picture[0, -1] == 0
    assert not equalize_depth(np.zeros((4, 6))).any()
    with pytest.raises(ConfigurationError, match="outside of the map"):
        equalize_depth(np.ones((4, 4)), (10, 10, 2, 2))
