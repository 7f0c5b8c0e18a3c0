"""Open sources of frames by the options of commands."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from smartcam._cli.options import Options
    from smartcam.frames import FrameSource

TIMEOUT = "Longest wait for a frame; a device that gives none for so long has failed.  [default: 5]"


def is_source(text: str) -> bool:
    """Return True if a text is the URL of a source, not a file or folder."""
    return "://" in text


def make_source(url: str, options: Options, *, linger: float = 0.0) -> FrameSource:
    """Return an unopened source, which fails without a frame for ``--timeout`` seconds.

    Raises ConfigurationError: the URL is wrong.
    """
    from smartcam.frames import open as open_frames
    from smartcam.frames._inside import FRAME_TIMEOUT

    seconds = options.step_timeout(FRAME_TIMEOUT)
    return open_frames(url, timeout=seconds, stall=seconds, linger=linger)
