"""Disparity, compared with known scenes and OpenCV's own pair."""

from __future__ import annotations

import gzip
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from smartcam._extras import load
from smartcam.depth import StereoMatcher
from smartcam.exceptions import ConfigurationError, FrameFormatError
from tests.depth.scenes import Scene, plane, step

MIN_COARSE_SIGMA_PX = 0.5


ALOE = Path("/usr/share/doc/opencv-doc/examples/data")
"""Place of the pair in Debian's package opencv-doc."""


def matcher(**other: Any) -> StereoMatcher:
    return StereoMatcher(**({"num_disparities": 64} | other))


class Compared(NamedTuple):
    """A disparity with its true value."""

    coverage: float  # of what both cameras see
    refined: float  # part of that
    found: float  # rms error of what was refined, pixels
    told: float  # rms of its sigma
    ratio: float  # rms of error / sigma


def rms(values: NDArray[Any]) -> float:
    return float(np.sqrt(np.mean(values.astype(np.float64) ** 2)))


def compared(found: Any, scene: Scene) -> Compared:
    error = found.pixels - scene.truth
    known = np.isfinite(found.pixels) & scene.seen
    fine = known & (found.sigma < MIN_COARSE_SIGMA_PX)
    return Compared(
        known.sum() / scene.seen.sum(),
        fine.sum() / known.sum(),
        rms(error[fine]),
        rms(found.sigma[fine]),
        rms(error[fine] / found.sigma[fine]),
    )


SCENES = {
    "little noise": partial(plane, (20.3, 0, 0), noise=0.5),
    "some noise": partial(plane, (20.3, 0, 0), noise=2),
    "much noise": partial(plane, (20.3, 0, 0), noise=8),
    "little contrast": partial(plane, (20.3, 0, 0), noise=2, contrast=5),
    "fine": partial(plane, (20.3, 0, 0), noise=2, finest=3),
    "soft": partial(plane, (20.3, 0, 0), noise=2, finest=12),
    "across": partial(plane, (30.0, 0.15, 0), noise=2),
    "down": partial(plane, (30.0, 0, 0.2), noise=2),
    "both": partial(plane, (30.0, 0.12, 0.1), noise=2, brighter=10),
    "a board before a wall": partial(step, 12.4, 30.7, noise=2),
}


@cache
def measured(name: str) -> Any:
    """Return a scene, and what is found in it."""
    scene = SCENES[name]()
    return scene, compared(matcher()(scene.left, scene.right), scene)


@pytest.mark.parametrize("name", SCENES)
def test_sigma_equals_the_noise(name: str) -> None:
    _, seen = measured(name)
    assert seen.coverage > 0.98
    assert seen.refined > 0.9
    assert 0.8 < seen.told / seen.found < 1.2
    assert 0.8 < seen.ratio < 1.2  # of each pixel, not only of all together


@pytest.mark.sampled(every=2)
@pytest.mark.parametrize("gain", [0.85, 1.15])
@pytest.mark.parametrize("name", ["little noise", "some noise", "much noise", "fine", "both"])
def test_unlike_exposures_cost_neither_the_disparity_nor_its_sigma(name: str, gain: float) -> None:
    scene, alike = measured(name)
    right = np.clip(np.round(scene.right * gain - 5), 0, 255).astype(np.uint8)
    seen = compared(matcher()(scene.left, right), scene)
    assert seen.refined > 0.85
    assert seen.found < 1.25 * alike.found  # of a constant alone it was six times as much
    assert 0.8 < seen.told / seen.found < 1.2
    assert 0.8 < seen.ratio < 1.2


def test_refined_disparities_are_four_times_as_good_as_opencv_s() -> None:
    scene = SCENES["some noise"]()
    ours, opencv = (matcher(refine=side)(scene.left, scene.right) for side in (9, 0))
    assert np.nanmin(opencv.sigma) == np.nanmax(opencv.sigma) == MIN_COARSE_SIGMA_PX
    known = np.isfinite(ours.pixels) & (ours.sigma < MIN_COARSE_SIGMA_PX) & scene.seen
    errors = [rms((one.pixels - scene.truth)[known]) for one in (ours, opencv)]
    assert errors[0] * 4 < errors[1]
    assert abs(np.mean((ours.pixels - scene.truth)[known])) < 0.005


@pytest.mark.parametrize("algorithm", ["sgbm", "bm"])
def test_point_seen_by_one_camera_has_no_disparity(algorithm: str) -> None:
    scene = step(12.4, 30.7, noise=1)
    alone = {"algorithm": algorithm, "uniqueness_ratio": 0, "speckle_window_size": 0}
    with_check = matcher(**alone)(scene.left, scene.right).pixels
    without = matcher(**alone, left_right=None)(scene.left, scene.right).pixels
    found = matcher(algorithm=algorithm)(scene.left, scene.right).pixels
    hidden = ~scene.seen
    hidden[:, :31] = False
    assert hidden.sum() > 1000
    assert np.isfinite(with_check[hidden]).mean() < 0.5 * np.isfinite(without[hidden]).mean()
    assert np.isfinite(found[hidden]).mean() < 0.25
    known = np.isfinite(found) & scene.seen
    assert np.mean(np.abs(found - scene.truth)[known] > 1) < 0.02


def test_points_near_the_left_border_are_found() -> None:
    scene = plane((20.3, 0, 0), noise=1)
    found = matcher()(scene.left, scene.right).pixels
    assert np.isfinite(found[:, 22:64]).mean() > 0.97  # OpenCV alone leaves out the first 64
    assert not np.isfinite(found[:, :19]).any()  # the right camera does not see these


def test_disparities_below_0_are_found() -> None:
    scene = plane((20.3, 0, 0), noise=1)
    found = StereoMatcher(min_disparity=-32, num_disparities=32)(scene.right, scene.left).pixels
    assert np.isfinite(found[:, :-22]).mean() > 0.95
    assert np.nanmedian(found) == pytest.approx(-20.3, abs=0.01)


def test_colours_are_made_grey() -> None:
    scene = plane((20.3, 0, 0), noise=1)
    grey = matcher()(scene.left, scene.right)
    colour = matcher()(*(np.repeat(one[..., None], 3, axis=2) for one in (scene.left, scene.right)))
    np.testing.assert_array_equal(grey.pixels, colour.pixels)
    assert grey.pixels.dtype == grey.sigma.dtype == np.float32
    assert grey.pixels.shape == scene.left.shape
    np.testing.assert_array_equal(np.isnan(grey.pixels), np.isnan(grey.sigma))


def test_same_pictures_have_same_disparity() -> None:
    scene, one = plane((20.3, 0.05, 0), noise=2), matcher()
    first = one(scene.left, scene.right)
    one(scene.right, scene.left)
    np.testing.assert_array_equal(first.pixels, one(scene.left, scene.right).pixels)


def test_pictures_without_texture_have_no_sure_disparity() -> None:
    flat = np.full((120, 160), 90, np.uint8)
    found = matcher()(flat, flat)
    assert not (found.sigma < MIN_COARSE_SIGMA_PX).any()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"algorithm": "elas"}, "expected sgbm or bm, got 'elas'"),
        ({"num_disparity": 64}, "no parameter 'num_disparity'; there are min_disparity, "),
        ({"num_disparity": 64}, "did you mean 'num_disparities'"),
        ({"algorithm": "bm", "P1": 8}, "bm: no parameter 'P1'"),
        ({"num_disparities": 100}, "num_disparities: expected 16 to 4096, a multiple of 16"),
        ({"block_size": 4}, "block_size: expected 1 to 51, odd, got 4"),
        ({"algorithm": "bm", "block_size": 3}, "block_size: expected 5 to 255, odd, got 3"),
        ({"mode": "fast"}, "mode: expected sgbm_3way or sgbm or hh or hh4, got 'fast'"),
        ({"P1": 100, "P2": 50}, "P2: expected more than P1, 100, got 50"),
        ({"uniqueness_ratio": True}, "uniqueness_ratio: expected 0 to 100, got True"),
        ({"uniqueness_ratio": 5.5}, "uniqueness_ratio: expected 0 to 100, got 5.5"),
        ({"left_right": -1}, "left_right: expected 0 to 4096 pixels or None"),
        ({"left_right": float("nan")}, "left_right: expected"),
        ({"refine": 4}, "refine: expected one of"),
    ],
)
def test_wrong_parameters_are_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        StereoMatcher(**options)


@pytest.mark.parametrize("shape", [(10, 20, 4), (10,), (2, 20)])
def test_pictures_that_are_none_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(FrameFormatError, match="expected"):
        matcher()(np.zeros(shape, np.uint8), np.zeros(shape, np.uint8))


def test_pictures_that_do_not_fit_are_refused() -> None:
    with pytest.raises(FrameFormatError, match="20x10 and 21x10"):
        matcher()(np.zeros((10, 20), np.uint8), np.zeros((10, 21), np.uint8))
    with pytest.raises(FrameFormatError, match=r"left: .*got .* of float64"):
        matcher()(np.zeros((10, 20)), np.zeros((10, 20), np.uint8))  # type: ignore[arg-type]


def test_weighted_least_squares_need_an_opencv_that_has_them() -> None:
    if hasattr(cv2, "ximgproc"):
        with pytest.raises(ConfigurationError, match="wls: expected lambda and sigma"):
            StereoMatcher(wls=(0, 1))
        scene = plane((20.3, 0, 0), noise=2)
        found = matcher(wls=(8000, 1.5), refine=0)(scene.left, scene.right).pixels
        assert np.nanmedian(found) == pytest.approx(20.3, abs=0.2)
        return
    with pytest.raises(ConfigurationError, match="opencv-contrib-python"):
        StereoMatcher(wls=(8000, 1.5))


# ---------------------------------------------------------------------- OpenCV's own pair


def _aloe(name: str) -> NDArray[np.uint8]:
    for path in (ALOE / name, ALOE / f"{name}.gz"):
        if path.exists():
            data = path.read_bytes()
            data = gzip.decompress(data) if path.suffix == ".gz" else data
            kind = cv2.IMREAD_GRAYSCALE if "GT" in name else cv2.IMREAD_COLOR_RGB
            return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), kind), dtype=np.uint8)
    pytest.skip(f"no {name} in {ALOE}: Debian's package opencv-doc has it")


class Score(NamedTuple):
    coverage: float  # of the pixels whose truth is known
    bad: tuple[float, float]  # part of these that is more than 1 and 2 pixels off


def score(disparity: NDArray[Any], truth: NDArray[np.uint8]) -> Score:
    known = truth > 0
    found = known & (np.nan_to_num(disparity) > 0)
    error = np.abs(disparity - truth)[found]
    return Score(found.sum() / known.sum(), (np.mean(error > 1), np.mean(error > 2)))


@pytest.mark.long
def test_aloe_is_found_better_than_by_opencv_s_sample() -> None:
    left, right, truth = _aloe("aloeL.jpg"), _aloe("aloeR.jpg"), _aloe("aloeGT.png")
    ours = score(StereoMatcher(num_disparities=224)(left, right).pixels, truth)
    for first, count in ((16, 96), (0, 224)):  # the sample's range, and that of the truth
        sample = load("cv2").StereoSGBM_create(
            minDisparity=first,
            numDisparities=count,
            blockSize=16,
            P1=8 * 3 * 3**2,
            P2=32 * 3 * 3**2,
            disp12MaxDiff=1,
            uniquenessRatio=10,
            speckleWindowSize=100,
            speckleRange=32,
        )
        pictures = (np.ascontiguousarray(one[..., ::-1]) for one in (left, right))
        found = sample.compute(*pictures) / 16
        theirs = score(np.where(found >= first, found, np.nan), truth)
        assert ours.coverage > theirs.coverage + 0.1
        assert ours.bad[0] < theirs.bad[0]
        assert ours.bad[1] < theirs.bad[1] / 2
