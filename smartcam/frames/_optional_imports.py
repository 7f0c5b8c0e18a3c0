"""What the extras bring, imported where it is first used."""

from __future__ import annotations

import importlib
import sys
from typing import Any, Final

from smartcam.exceptions import MissingExtraError

EXTRAS: Final = {
    "simplejpeg": ("JPEG needs simplejpeg", "frames"),
    "imagecodecs": ("PNG and JPEG XL need imagecodecs", "frames"),
    "av": ("video needs PyAV", "video"),
    "cv2": ("the colours of a Bayer pattern need OpenCV", "calibration"),
}
"""What for, and the extra, of each module."""

_LOADED: Final[dict[str, Any]] = {}  # whole; sys.modules has those that another thread is at, too


def load(name: str) -> Any:
    """Return a module that an extra brings; untyped, which is why it is any.

    Raises MissingExtraError: it is not installed.
    """
    there = sys.modules.get(name)
    if there is not None and there is _LOADED.get(name):
        return there  # import_module looks for longer than a small picture takes
    try:
        _LOADED[name] = module = importlib.import_module(name)
    except ImportError as exc:
        reason, extra = EXTRAS[name.partition(".")[0]]
        raise MissingExtraError(f'{reason}: pip install "smartcam[{extra}]"', extra=extra) from exc
    return module
