"""Sources of frames, as commands open them."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from smartcam._cli.options import Options
    from smartcam.frames import FrameSource

TIMEOUT = (
    "Bound of the wait for a frame, and of a device that streams and gives no frame.  [default: 5]"
)


def is_source(text: str) -> bool:
    """Return True if a text is the URL of a source, not a file or folder."""
    return "://" in text


def opened(url: str, options: Options, *, linger: float = 0.0) -> FrameSource:
    """Return an unopened source; one without a frame for ``--timeout`` counts as stuck.

    Raises ConfigurationError: the URL is wrong.
    """
    from smartcam.frames import open as open_frames
    from smartcam.frames._inside import FRAME_TIMEOUT

    seconds = options.step(FRAME_TIMEOUT)
    return open_frames(url, timeout=seconds, stall=seconds, linger=linger)
