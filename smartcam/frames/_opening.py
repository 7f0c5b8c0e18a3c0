"""Open sources of frames by their URLs."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Final, cast

from smartcam._arguments import check_text
from smartcam._suggestions import did_you_mean
from smartcam.exceptions import ConfigurationError
from smartcam.frames._address import FrameAddress
from smartcam.frames._reader import FRAME_TIMEOUT
from smartcam.frames._source import FrameSource
from smartcam.registry import FRAMES

if TYPE_CHECKING:
    from smartcam.frames._driver import FoundSource, FrameDriver
    from smartcam.geometry import CameraModel


RECORDING_SCHEME: Final = "mcap"
"""Scheme whose driver reads recordings."""

RECORDING_SUFFIX: Final = ".mcap"


def open(
    url: str,
    *,
    camera_info: CameraModel | None = None,
    timeout: float | None = FRAME_TIMEOUT,
    stall: float | None = 5.0,
    linger: float = 0.0,
) -> FrameSource:
    """Return a source of frames; ``async with`` opens it.

    Args:
        url: ``v4l2:///dev/video0?format=YUYV&size=640x480&fps=30``, ``gige://HOST``,
            ``rtsp://...``, ``http://...``, ``rtp://...``, ``synthetic://``, ``insight://...``, or
            the path of a file, also of a recording (``run.mcap``) or a folder of recordings.
        camera_info: lens of the camera, which is added to every frame.
        timeout: seconds that an iteration waits for a frame; None: without limit.
        stall: seconds without a frame after which a streaming device counts as stuck; None: never.
        linger: seconds for which the source streams after its last reader has gone.

    Raises:
        ConfigurationError: the URL is wrong; the text names the known schemes or parameters.
    """
    address = FrameAddress.parse(url)
    scheme = RECORDING_SCHEME if _is_recording(address) else address.scheme
    driver = _driver(scheme, address.shown)(address)
    return FrameSource(driver, camera_info=camera_info, timeout=timeout, stall=stall, linger=linger)


async def discover(scheme: str | None = None) -> list[FoundSource]:
    """Find sources on this machine and its network.

    Args:
        scheme: scheme of the sources; None: all schemes.

    Raises:
        ConfigurationError: the scheme is unknown.
    """
    if scheme is None:
        schemes = [info.name for info in FRAMES.available()]
    else:
        schemes = [check_text(scheme, "scheme", "discover", most=100)]
    drivers = dict.fromkeys(_driver(name, name) for name in schemes)
    return [source for driver in drivers for source in await driver.discover()]


def _is_recording(address: FrameAddress) -> bool:
    """Return True if a path is an MCAP file or a folder with MCAP files."""
    if address.scheme != "file":
        return False
    path = Path(re.sub(r"#\w+=[^#/]*$", "", address.path))
    if path.suffix.lower() == RECORDING_SUFFIX:
        return True
    return path.is_dir() and next(path.glob(f"*{RECORDING_SUFFIX}"), None) is not None


def _driver(scheme: str, url: str) -> type[FrameDriver]:
    if scheme not in FRAMES:
        known = [info.name for info in FRAMES.available()]
        raise ConfigurationError(
            f"frame source {url!r}: unknown scheme {scheme!r}; known are "
            f"{', '.join(f'{name}://' for name in known)}{did_you_mean(scheme, known)}"
        )
    return cast("type[FrameDriver]", FRAMES.load(scheme))
