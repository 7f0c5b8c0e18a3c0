"""Depth from two cameras: from frames to metres."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from smartcam.calibration import CameraModel, StereoCalibration, Transform, calibrate_stereo
from smartcam.calibration._inside import rectify
from smartcam.calibration.formats import CameraChain, write_camera_info
from smartcam.depth import StereoDepth, StereoMatcher, read_camera_infos
from smartcam.depth._pair import CalibratedPair, _covariance_root, scale_camera
from smartcam.depth._stereo import _upper_bits
from smartcam.depth._subpixel import MIN_COARSE_SIGMA_PX
from smartcam.exceptions import (
    CalibrationError,
    ConfigurationError,
    FrameFormatError,
    FrameTimeoutError,
    LocalProtocolError,
)
from smartcam.frames import Frame, FrameReader, FrameSource, find_format
from smartcam.geometry._inside import exp_rotation
from tests.calibration.lenskit import pairs
from tests.depth.scenes import Room
from tests.frames.drivers import GoneError, ScriptedDriver, frame
from tests.handmade import until

SIZE = (240, 160)


def lens(size: tuple[int, int], focal: float) -> CameraModel:
    return CameraModel(
        size=size,
        matrix=np.array([[focal, 0, size[0] / 2 - 3], [0, focal * 1.01, size[1] / 2], [0, 0, 1.0]]),
        distortion=np.array([-0.2, 0.05, 0.001, -0.001, 0]),
    )


TURN = np.array(cv2.Rodrigues(np.array([0.02, -0.03, 0.015]))[0], dtype=np.float64)
RIGHT_LEFT = Transform("right", "left", TURN, np.array([-0.12, 0.003, 0.002]))
LEFT, RIGHT = lens(SIZE, 210.0), lens(SIZE, 215.0)
CHAIN = CameraChain(cameras=(LEFT, RIGHT), transforms=(RIGHT_LEFT,), names=("left", "right"))
ROOM = Room((1.6, 0.2, 0.1), 0.9, detail=0.04)


def shown(picture: NDArray[np.uint8], number: int = 1, **other: Any) -> Frame:
    """Return a frame of a picture, (H, W) or (H, W, 3)."""
    height, width = picture.shape[:2]
    about = {
        "data": picture.tobytes(),
        "format": find_format("Mono8" if picture.ndim == 2 else "RGB8"),
        "width": width,
        "height": height,
        "stride": picture.nbytes // height,
    }
    return frame(number, **(about | other))


def drivers(**options: Any) -> tuple[ScriptedDriver, ScriptedDriver, StereoDepth]:
    left, right = ScriptedDriver(), ScriptedDriver()
    calibration = options.pop("calibration", CHAIN)
    options = {"matcher": StereoMatcher(num_disparities=48)} | options
    return left, right, StereoDepth(FrameSource(left), FrameSource(right), calibration, **options)


async def streaming(cameras: StereoDepth, *found: ScriptedDriver) -> asyncio.Task[Any]:
    waiting = asyncio.ensure_future(anext(cameras))
    await until(lambda: all(one.sink is not None for one in found))
    return waiting


def give(
    pictures: tuple[NDArray[np.uint8], NDArray[np.uint8]], number: int, *found: ScriptedDriver
) -> None:
    """Make both cameras deliver pictures of the same moment."""
    now = time.monotonic()
    for one, picture in zip(found, pictures, strict=True):
        one.give(shown(picture, number, captured=now))


@functools.cache
def drawn(right_size: tuple[int, int] = SIZE) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    left, right = CHAIN.cameras
    return (
        ROOM.picture(left, noise=2, seed=1),
        ROOM.picture(scale_camera(right, right_size), RIGHT_LEFT, noise=2, seed=2),
    )


def truth(camera_info: CameraModel) -> NDArray[np.float64]:
    return ROOM.depth(camera_info, rectify(LEFT, RIGHT, RIGHT_LEFT).rotations[0])


@pytest.mark.real_time
async def test_two_cameras_measure_depth_and_sigma() -> None:
    left, right, cameras = drivers()
    pictures = drawn((360, 240))  # the right one is larger than it was calibrated
    async with cameras:
        waiting = await streaming(cameras, left, right)
        now = time.monotonic() - 0.1
        left.give(shown(np.repeat(pictures[0][..., None], 3, axis=2), 7, captured=now))
        right.give(shown(pictures[1], 9, captured=now - 0.004))
        found = await waiting
        assert found.camera_info is cameras.camera_info
    assert found.depth.shape == found.sigma.shape == found.disparity.shape == (160, 240)
    assert {one.dtype for one in (found.depth, found.sigma, found.disparity)} == {np.dtype("f4")}
    assert found.left.shape == (160, 240, 3)
    assert found.baseline == pytest.approx(np.linalg.norm(RIGHT_LEFT.translation))
    assert (found.captured, found.sequences) == (now, (7, 9))
    assert found.skew == pytest.approx(-0.004)
    known = found.depth > 0
    np.testing.assert_array_equal(known, np.isfinite(found.disparity))
    np.testing.assert_array_equal(known, np.isfinite(found.sigma))
    assert known[:, 40:].mean() > 0.93
    error = found.depth - truth(found.camera_info)
    focal = found.camera_info.matrix[0, 0]
    sigma_disparity = found.sigma * focal * found.baseline / np.maximum(found.depth, 0.1) ** 2
    fine = known & (sigma_disparity < MIN_COARSE_SIGMA_PX)
    assert fine.sum() > 0.9 * known.sum()
    assert np.median(np.abs(error[fine])) < 0.006
    spread = 1.4826 * np.median(np.abs(error[fine]) / found.sigma[fine])
    assert 0.8 < spread < 1.2
    assert np.mean(np.abs(error[fine]) > 4 * found.sigma[fine]) < 0.01


@pytest.mark.real_time
async def test_pairs_during_matching_are_skipped_except_the_newest() -> None:
    left, right, cameras = drivers()
    pictures = drawn()
    async with cameras:
        waiting = await streaming(cameras, left, right)
        start = time.monotonic() - 10
        for number in range(1, 6):
            left.give(shown(pictures[0], number, captured=start + number * 0.1))
            right.give(shown(pictures[1], number, captured=start + number * 0.1))
        assert (await waiting).sequences == (5, 5)
        for number in (6, 7, 8):
            left.give(shown(pictures[0], number, captured=start + number * 0.1))
            right.give(shown(pictures[1], number, captured=start + number * 0.1 + 0.003))
        assert (await anext(cameras)).sequences == (8, 8)
        account = cameras.statistics()
        assert (account.group.delivered, account.group.skipped) == (2, 6)
        assert account.group.skew == pytest.approx(0.003)
        assert account.skew == pytest.approx(0.0015)
        assert (account.drift, account.drift_from) == (None, "")


@pytest.mark.real_time
async def test_cancelling_during_matching_leaves_the_pair_working() -> None:
    left, right, cameras = drivers()
    pictures = drawn()
    async with cameras:
        waiting = await streaming(cameras, left, right)
        give(pictures, 1, left, right)
        await until(lambda: cameras.statistics().group.delivered == 1)
        worker = cameras._require_open()[0]
        assert worker._running is not None
        assert not worker._running.done()
        waiting.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await waiting
        again = asyncio.ensure_future(anext(cameras))
        for number in (2, 3):
            give(pictures, number, left, right)
        assert (await again).sequences in ((2, 2), (3, 3))


@pytest.mark.real_time
async def test_a_cut_picture_is_refused_and_the_next_pair_is_matched() -> None:
    left, right, cameras = drivers(colour=False)
    pictures = drawn()
    async with cameras:
        waiting = await streaming(cameras, left, right)
        give((pictures[0][:120], pictures[1]), 1, left, right)
        with pytest.raises(FrameFormatError, match=r"ratio of 240x160, with .* got 240x120"):
            await waiting
        give(pictures, 2, left, right)
        assert (await anext(cameras)).left.shape == (160, 240)


async def test_pair_ends_with_its_cameras_and_opens_once() -> None:
    left, right, cameras = drivers(timeout=1)
    with pytest.raises(LocalProtocolError, match="not open"):
        await anext(cameras)
    with pytest.raises(LocalProtocolError, match="not open"):
        _ = cameras.baseline
    async with cameras:
        assert cameras.min_depth == pytest.approx(
            cameras.camera_info.matrix[0, 0] * cameras.baseline / 47
        )
        waiting = await streaming(cameras, left, right)
        with pytest.raises(FrameTimeoutError):
            await waiting
        waiting = asyncio.ensure_future(anext(cameras))
        await asyncio.sleep(0)
        assert right.sink is not None
        right.sink.ended(GoneError("unplugged", source="right"))
        with pytest.raises(GoneError):
            await waiting
    assert left.calls[-1] == right.calls[-1] == "close"
    with pytest.raises(LocalProtocolError, match="opened before"):
        await cameras.__aenter__()


async def test_nothing_stays_open_when_a_camera_is_not_there() -> None:
    left, right, cameras = drivers()
    right.fails["open"] = GoneError("not there", source="right")
    with pytest.raises(GoneError):
        await cameras.__aenter__()
    assert left.calls == ["open", "close"]
    del right.fails["open"]
    async with cameras:
        assert cameras.baseline > 0


@pytest.mark.real_time
async def test_readers_of_frames_are_paired_as_sources_are() -> None:
    """Readers from ``camera.frames()`` are paired like sources."""
    found = ScriptedDriver(), ScriptedDriver()
    pictures = drawn()
    closed: list[str] = []

    @contextlib.asynccontextmanager
    async def frames(driver: ScriptedDriver) -> AsyncIterator[FrameReader]:
        async with FrameSource(driver) as source, source.reader() as reader:
            yield reader
        closed.append(driver.name)

    cameras = StereoDepth(
        frames(found[0]), frames(found[1]), CHAIN, matcher=StereoMatcher(num_disparities=48)
    )
    opening = asyncio.ensure_future(cameras.__aenter__())
    for one, picture in zip(found, pictures, strict=True):
        await one.streams()
        one.give(shown(picture, 1))
    await opening
    waiting = asyncio.ensure_future(anext(cameras))
    for number in (2, 3):
        give(pictures, number, *found)
        await asyncio.sleep(0.01)
    depth = (await waiting).depth
    assert np.median(depth[depth > 0]) == pytest.approx(1.5, abs=0.2)
    await cameras.close()
    assert closed == ["scripted", "scripted"]


# ---------------------------------------------------------------------- drift


async def test_the_drift_of_the_clocks_is_found() -> None:
    """Without clocks of the cameras, frame numbers give the drift."""
    left, right, cameras = drivers()
    async with cameras:
        start = 1000.0
        for number in range(400):
            # the right one's clock is 200 parts in a million faster
            cameras._clock.add_pair(
                frame(number, captured=start + number / 30),
                frame(number, captured=start + 0.002 + number / 30 / (1 + 200e-6)),
            )
        account = cameras.statistics()
        assert account.drift == pytest.approx(200e-6, rel=0.01)
        assert account.drift_from == "frames"
        assert account.skew == pytest.approx(0.002 - 385 / 30 * 200e-6, abs=2e-5)
        # other rates are no drift
        for number in range(400):
            cameras._clock.add_pair(
                frame(number, captured=2000 + number / 30),
                frame(number, captured=2000 + number / 25),
            )
        assert cameras.statistics().drift is None
    assert (left.calls, right.calls) == (["open", "close"], ["open", "close"])


async def test_clocks_that_tell_the_time_tell_the_drift() -> None:
    left, right, cameras = drivers()
    async with cameras:
        waiting = await streaming(cameras, left, right)
        waiting.cancel()
        start = time.monotonic() - 100
        for number in range(300):
            at = start + number / 30
            left.give(frame(number, captured=at, device_time=50 + number / 30 * (1 + 50e-6)))
            right.give(frame(number, captured=at, device_time=90 + number / 30 * (1 - 100e-6)))
        account = cameras.statistics()
        assert account.drift_from == "clocks"
        assert account.drift == pytest.approx(-150e-6, abs=2e-5)


# ---------------------------------------------------------------------- calibrations


def test_the_sigma_of_the_calibration_is_in_that_of_the_depth() -> None:
    """Rectify a pair by transforms whose errors have its covariance: these twelve show it all."""
    rng = np.random.default_rng(5)
    factor = rng.normal(size=(6, 6)) * np.array([5e-4] * 3 + [3e-4] * 3)[:, None]
    covariance = factor @ factor.T
    left, right = CHAIN.cameras
    pair = made(CHAIN)
    spots = np.array([[50, 40], [120, 80], [200, 130], [120, 20]])
    depth = np.array([1.0, 1.5, 2.0, 0.8])
    first = rectify(left, right, RIGHT_LEFT)
    rays = np.column_stack([pair.camera_info.directions(spots.astype(float)), np.ones(4)])
    points = (rays * depth[:, None]) @ first.rotations[0]
    seen = left.project(points), right.project(RIGHT_LEFT.apply(points))
    found = []
    for off in np.sqrt(6) * np.hstack([factor, -factor]).T:
        turn = exp_rotation(off[:3]) @ RIGHT_LEFT.rotation
        wrong = Transform("right", "left", turn, RIGHT_LEFT.translation + off[3:])
        flattened = rectify(left, right, wrong, size=SIZE)
        turns, projections = flattened.rotations, flattened.projections
        columns = []
        for side, camera in enumerate((left, right)):
            flat = np.column_stack([camera.directions(seen[side]), np.ones(4)])
            there = flat @ (projections[side][:, :3] @ turns[side]).T
            columns.append(there[:, 0] / there[:, 2])
        z = -projections[1][0, 3] / (columns[0] - columns[1])
        found.append(z - (points @ turns[0].T)[:, 2])
    whole = np.zeros((SIZE[1], SIZE[0]), np.float32)
    whole[spots[:, 1], spots[:, 0]] = depth
    told = made(CHAIN, covariance).depth_sigma(whole, np.zeros_like(whole))
    np.testing.assert_allclose(told[spots[:, 1], spots[:, 0]], np.std(found, axis=0), rtol=0.02)


def made(
    calibration: StereoCalibration | CameraChain,
    covariance: NDArray[np.float64] | None = None,
    **options: Any,
) -> CalibratedPair:
    given: dict[str, Any] = {"size": None, "alpha": 0.0, "focal_sigma": 0.0}
    pair = CalibratedPair(calibration, **(given | options))
    if covariance is not None:
        pair._covariance_root = _covariance_root(
            rectify(LEFT, RIGHT, RIGHT_LEFT).rotations[1], covariance
        )
    return pair


@pytest.mark.long
def test_a_calibration_of_ours_brings_its_covariance() -> None:
    calibration = calibrate_stereo(*pairs(6))
    pair = made(calibration)
    exact = made(CameraChain.of(calibration))
    flat = np.full((pair.size[1], pair.size[0]), 1.0, np.float32)
    sure, told = exact.depth_sigma(flat, flat * 0.1), pair.depth_sigma(flat, flat * 0.1)
    np.testing.assert_allclose(sure, 0.1 / (pair.focal * pair.baseline), rtol=0.02)
    assert (told > sure).all()
    focal = made(CameraChain.of(calibration), focal_sigma=3.0)
    np.testing.assert_allclose(
        focal.depth_sigma(flat, flat * 0),
        np.hypot(exact.depth_sigma(flat, flat * 0), 3 / pair.focal),
        rtol=0.01,
    )


def test_sizes_lenses_and_maps_go_together() -> None:
    large = made(CHAIN)
    small = made(CHAIN, size=(120, 80))
    assert small.camera_info.size == small.size == (120, 80)
    assert small.focal == pytest.approx(large.focal / 2, rel=0.01)
    assert small.baseline == pytest.approx(large.baseline)
    lens_small = scale_camera(CHAIN.cameras[0], (120, 80))
    points = np.array([[0.1, -0.05, 1.0], [-0.2, 0.1, 1.2]])
    np.testing.assert_allclose(
        lens_small.project(points) * 2 + 0.5, CHAIN.cameras[0].project(points), atol=1e-9
    )
    soft = ROOM._replace(detail=0.1)
    expected = large.rectify(soft.picture(CHAIN.cameras[0]), 0, "left")
    for size in ((120, 80), (360, 240)):
        found = large.rectify(soft.picture(scale_camera(CHAIN.cameras[0], size)), 0, "left")
        assert np.median(np.abs(found.astype(float) - expected)) <= 1, size
        moved = np.roll(found, 1, axis=1).astype(float)
        assert np.median(np.abs(moved - expected)) >= 3, size  # of which a pixel would be seen


@pytest.mark.parametrize(
    ("translation", "said"),
    [([0.12, 0, 0], "right of the right one"), ([0, -0.12, 0], "above or below it")],
)
def test_cameras_that_are_not_side_by_side_are_refused(translation: list[float], said: str) -> None:
    other = Transform("right", "left", np.eye(3), np.array(translation))
    with pytest.raises(ConfigurationError, match=said):
        made(CameraChain(cameras=CHAIN.cameras, transforms=(other,), names=("a", "b")))


def test_camera_infos_of_ros_are_a_pair(tmp_path: Path) -> None:
    found = rectify(LEFT, RIGHT, RIGHT_LEFT)
    for name, camera, turn, projection in zip(
        ("left", "right"), CHAIN.cameras, found.rotations, found.projections, strict=True
    ):
        write_camera_info(
            tmp_path / f"{name}.yaml",
            camera,
            rectification=np.round(turn, 5),  # as ROS does
            projection=np.round(projection, 5),
        )
    pair = read_camera_infos(tmp_path / "left.yaml", tmp_path / "right.yaml")
    np.testing.assert_allclose(pair.transforms[0].rotation, RIGHT_LEFT.rotation, atol=3e-5)
    np.testing.assert_allclose(pair.transforms[0].translation, RIGHT_LEFT.translation, atol=3e-6)
    with pytest.raises(CalibrationError, match="the right camera of a pair"):
        read_camera_infos(tmp_path / "right.yaml", tmp_path / "left.yaml")
    write_camera_info(tmp_path / "bent.yaml", CHAIN.cameras[0], rectification=np.eye(3) * 1.1)
    with pytest.raises(CalibrationError, match="expected a rotation"):
        read_camera_infos(tmp_path / "bent.yaml", tmp_path / "right.yaml")
    (tmp_path / "none.yaml").write_bytes(b"\xff\xfe")
    with pytest.raises(CalibrationError, match="expected text"):
        read_camera_infos(tmp_path / "none.yaml", tmp_path / "right.yaml")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"alpha": 2}, "alpha: expected 0 to 1"),
        ({"focal_sigma": -1}, "focal_sigma: expected pixels"),
        ({"size": (0, 10)}, "size: expected width and height"),
        ({"size": (0.5, 10)}, "size: expected width and height"),
        ({"within": -1}, "within: expected seconds"),
    ],
)
def test_wrong_options_are_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        drivers(**options)


async def test_one_camera_is_no_pair() -> None:
    alone = CameraChain(cameras=CHAIN.cameras[:1], names=("left",))
    _, _, cameras = drivers(calibration=alone)
    with pytest.raises(ConfigurationError, match="expected the calibration of two cameras, got 1"):
        await cameras.__aenter__()


def test_pixels_without_source_have_no_disparity() -> None:
    pair = made(CHAIN, alpha=1.0)
    disparity = np.full((SIZE[1], SIZE[0]), 5, np.float32)
    pair.drop_outside(disparity)
    masks = rectify(LEFT, RIGHT, RIGHT_LEFT, alpha=1.0).masks
    assert np.isnan(disparity[~masks[0]]).all()
    np.testing.assert_array_equal(np.isfinite(disparity[:, 5:]), masks[0][:, 5:] & masks[1][:, :-5])


def test_frames_of_more_bits_are_seen_by_their_highest() -> None:
    pixels = np.array([[0, 512, 1023]], np.uint16)
    one = shown(np.zeros((1, 3), np.uint8), format=find_format("Mono10"))
    assert _upper_bits(one, pixels).tolist() == [[0, 128, 255]]
