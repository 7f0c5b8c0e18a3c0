"""Measure depth with two cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from smartcam._argument_checks import a_list, a_number, check_arguments, or_none
from smartcam._arguments import check_flag, excerpt
from smartcam.depth._from_reader import ReaderDriver
from smartcam.depth._matcher import MAX_DISPARITIES, StereoMatcher
from smartcam.depth._one_thread import OneThread
from smartcam.depth._pair import CalibratedPair
from smartcam.depth._pair_clock import PairClock
from smartcam.exceptions import ConfigurationError, LocalProtocolError
from smartcam.frames import FrameGroup, FrameSource
from smartcam.frames._inside import FRAME_TIMEOUT

if TYPE_CHECKING:
    from contextlib import AbstractAsyncContextManager
    from typing import Any, Self

    from numpy.typing import NDArray

    from smartcam.calibration import StereoCalibration
    from smartcam.calibration.formats import CameraChain
    from smartcam.frames import Frame, FrameReader, FrameSet
    from smartcam.frames._inside import GroupStatistics
    from smartcam.geometry import CameraModel

WIDTH_TO_DISPARITIES: Final = 5
"""Ratio of the picture's width to the default range of disparities."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DepthFrame:
    """The depth seen by two cameras at one moment, in the rectified left camera's view.

    Attributes:
        depth: (H, W), float32, metres along the optical axis; 0 where it is unknown.
        sigma: (H, W), float32, standard deviation of ``depth``, metres; NaN where it is unknown.
        disparity: (H, W), float32, pixels; NaN where it is unknown.
        left: the rectified left picture, uint8: (H, W), or, red first, (H, W, 3); 0 outside of the
            camera's picture.
        camera_info: lens of the rectified left camera, without distortion.
        baseline: metres between the cameras.
        captured: time of the left frame's capture, seconds of ``time.monotonic()``.
        utc: time of the left frame's capture, seconds since 1970.
        skew: seconds by which the right frame was captured later.
        sequences: sequence numbers of the left and the right frame.
    """

    depth: NDArray[np.float32]
    sigma: NDArray[np.float32]
    disparity: NDArray[np.float32]
    left: NDArray[np.uint8]
    camera_info: CameraModel
    baseline: float
    captured: float
    utc: float
    skew: float
    sequences: tuple[int, int]


@dataclass(frozen=True, slots=True)
class StereoStatistics:
    """Counts of a pair's frames, and the difference of its clocks.

    Attributes:
        group: statistics of the frames' pairing; its ``skew`` is the largest skew.
        skew: seconds by which the right frames are later: the median of the last pairs; None: no
            pair came yet.
        drift: rate by which the right camera's clock is faster than the left camera's clock,
            seconds per second; None: not known yet.
        drift_from: source of ``drift``: ``clocks``, the cameras' own clocks; ``frames``, if they
            have none: the ratio of their frame counts at the same nominal rate; or "".
    """

    group: GroupStatistics
    skew: float | None
    drift: float | None
    drift_from: str


class StereoDepth:
    """Two cameras and their calibration; iterate to get the newest :class:`DepthFrame`.

    ::

        calibration = StereoCalibration.load("pair.json")
        async with StereoDepth(open(LEFT), open(RIGHT), calibration) as cameras:
            async for frame in cameras:
                frame.depth, frame.sigma, frame.skew

    The frames may have any size of the calibrated aspect ratio, and any format with brightness.
    They are paired by capture time. Matching runs in a thread, on demand: a slow reader skips
    pairs, and never lags.

    Args:
        left: source of the left camera, as from ``smartcam.frames.open`` or ``camera.frames()``,
            not open; this object opens and closes it.
        right: source of the right camera.
        calibration: calibration of the pair: smartcam's own, or one from :func:`read_camera_infos`
            or from ``smartcam.calibration.formats.read_cameras`` with two cameras.
        matcher: matcher of the pictures; None: ``sgbm`` for disparities up to a fifth of the width.
        size: width and height of the rectified pictures, pixels; None: the size of the left
            calibration.
        alpha: share of the pictures that is kept, from 0: only valid pixels, to 1: all source
            pixels.
        colour: whether :attr:`DepthFrame.left` is in colour.
        focal_sigma: standard deviation of the focal length, pixels of the calibrated left picture;
            a calibration of a pair has only the uncertainty of the poses.
        within: largest skew, seconds; None: half of the time between two frames.
        timeout: seconds that an iteration waits for a pair; None: without limit.

    Raises:
        ConfigurationError: a value that is not valid, or a calibration of other than two cameras.
    """

    @check_arguments(size=or_none(a_list), alpha=a_number, colour=check_flag, focal_sigma=a_number)
    def __init__(
        self,
        left: FrameSource | AbstractAsyncContextManager[FrameReader],
        right: FrameSource | AbstractAsyncContextManager[FrameReader],
        calibration: StereoCalibration | CameraChain,
        *,
        matcher: StereoMatcher | None = None,
        size: tuple[int, int] | None = None,
        alpha: float = 0.0,
        colour: bool = True,
        focal_sigma: float = 0.0,
        within: float | None = None,
        timeout: float | None = FRAME_TIMEOUT,
    ) -> None:
        if not 0 <= alpha <= 1:
            raise ConfigurationError(f"stereo: alpha: expected 0 to 1, got {excerpt(alpha)}")
        if not 0 <= focal_sigma < math.inf:
            raise ConfigurationError(
                f"stereo: focal_sigma: expected pixels, got {excerpt(focal_sigma)}"
            )
        if size is not None and not (
            len(size) == 2 and all(isinstance(count, int) and count > 0 for count in size)
        ):
            raise ConfigurationError(
                f"stereo: size: expected width and height, got {excerpt(size)}"
            )
        self._make_pair = partial(
            CalibratedPair, calibration, size=size, alpha=alpha, focal_sigma=focal_sigma
        )
        sources = {
            name: source
            if isinstance(source, FrameSource)
            else FrameSource(ReaderDriver(source, name), stall=None)
            for name, source in (("left", left), ("right", right))
        }
        self._group = FrameGroup(sources, within=within, timeout=timeout)
        self._matcher, self._colour = matcher, colour
        self._clock = PairClock()
        self._worker: OneThread | None = None
        self._pair: CalibratedPair | None = None
        self._closed = False

    async def __aenter__(self) -> Self:
        """Compute the rectification maps, and open both cameras; they do not stream yet.

        Raises:
            CalibrationError: the rectified pictures would be empty.
            ConfigurationError: the cameras are swapped, or one above the other.
            FrameSourceError: a camera cannot be opened; nothing stays open.
            MissingExtraError: OpenCV (extra ``depth``) is not installed.

        Cancellation: nothing stays open.
        """
        if self._worker is not None or self._closed:
            raise LocalProtocolError("the pair of cameras was opened before; make a new one")
        self._worker = OneThread("stereo")
        try:
            self._pair = await self._worker.run(self._make_pair)
            if self._matcher is None:
                self._matcher = _default_matcher(self._pair.size[0])
            await self._group.__aenter__()
        except BaseException:
            await self._end_thread()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close both cameras and end the thread. Idempotent.

        Cancellation: as in :meth:`FrameSource.close`; the thread ends nevertheless.
        """
        self._closed = True
        try:
            await self._group.close()
        finally:
            await self._end_thread()

    async def _end_thread(self) -> None:
        worker, self._worker, self._pair = self._worker, None, None
        if worker is not None:
            await worker.close()

    @property
    def camera_info(self) -> CameraModel:
        """The lens of the rectified left picture.

        Raises:
            LocalProtocolError: the pair is not open.
        """
        return self._require_open()[1].camera_info

    @property
    def rotation(self) -> NDArray[np.float64]:
        """The rotation (3, 3) from the left camera's frame into its rectified one."""
        return self._require_open()[1].rotation

    @property
    def baseline(self) -> float:
        """Metres between the cameras; raises as :attr:`camera_info` does."""
        return self._require_open()[1].baseline

    @property
    def min_depth(self) -> float:
        """Least depth that is measured, metres; raises as :attr:`camera_info` does."""
        _, pair, matcher = self._require_open()
        return pair.focal * pair.baseline / max(matcher.max_disparity, 1)

    def statistics(self) -> StereoStatistics:
        """Return the current statistics."""
        sources = self._group.sources
        clocks = [sources[name].statistics().clock for name in ("left", "right")]
        skew = self._clock.skew()
        return StereoStatistics(self._group.statistics(), skew, *self._clock.drift(clocks))

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> DepthFrame:
        """Return the depth of the newest pair.

        Raises:
            FrameTimeoutError: no pair came in time.
            FrameFormatError: a frame is cut, or has no brightness; later frames may be good.
            FrameSourceError: a camera ended with an error.
            LocalProtocolError: the pair is not open.

        Cancellation: safe; the pair that is being matched is dropped. The next call waits until
        matching ends, then uses the newest pair.
        """
        worker, pair, matcher = self._require_open()
        await worker.wait_until_idle()
        frame_pair = await anext(self._group)
        self._clock.add_pair(frame_pair["left"], frame_pair["right"])
        return await worker.run(partial(_measure_depth, frame_pair, pair, matcher, self._colour))

    def _require_open(self) -> tuple[OneThread, CalibratedPair, StereoMatcher]:
        if self._worker is None or self._pair is None or self._matcher is None:
            raise LocalProtocolError("the pair of cameras is not open: use `async with`")
        return self._worker, self._pair, self._matcher


def _default_matcher(width: int) -> StereoMatcher:
    return StereoMatcher(
        num_disparities=min(MAX_DISPARITIES, 16 * math.ceil(width / WIDTH_TO_DISPARITIES / 16))
    )


def _measure_depth(
    frame_pair: FrameSet, pair: CalibratedPair, matcher: StereoMatcher, colour: bool
) -> DepthFrame:
    left, right = frame_pair["left"], frame_pair["right"]
    grey = [
        pair.rectify(_upper_bits(frame, frame.grey()), side, frame.source)
        for side, frame in enumerate((left, right))
    ]
    disparities = matcher(grey[0], grey[1])
    disparity = disparities.pixels
    pair.drop_outside(disparity)
    disparity[~(disparity > 0)] = np.nan  # at infinity, or behind the camera
    depth = pair.to_depth(disparity)
    left_picture = (
        pair.rectify(_upper_bits(left, left.rgb()), 0, left.source) if colour else grey[0]
    )
    return DepthFrame(
        depth=depth,
        sigma=pair.depth_sigma(depth, disparities.sigma),
        disparity=disparity,
        left=left_picture,
        camera_info=pair.camera_info,
        baseline=pair.baseline,
        captured=left.captured,
        utc=left.utc,
        skew=right.captured - left.captured,
        sequences=(left.sequence, right.sequence),
    )


def _upper_bits(frame: Frame, pixels: NDArray[Any]) -> NDArray[np.uint8]:
    """Return pixels as uint8: the 8 highest bits of each."""
    if pixels.dtype == np.uint8:
        return pixels
    return (pixels >> (frame.format.depth - 8)).astype(np.uint8)
