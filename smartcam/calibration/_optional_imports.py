"""What the extra ``calibration`` brings, imported where it is first used."""

from __future__ import annotations

import importlib
from typing import Any

from smartcam.exceptions import MissingExtraError

BROKEN = "5.0.0"
"""The OpenCV whose Python binding lacks hand-eye calibration (opencv/opencv#29565)."""


def load(name: str) -> Any:
    """Return a module of SciPy or OpenCV; untyped, which is why it is any.

    Raises MissingExtraError: it is not installed, or it is OpenCV 5.0.0.
    """
    try:
        module = importlib.import_module(name)
    except ImportError as exc:
        raise MissingExtraError(
            f'calibration needs {name.partition(".")[0]}: pip install "smartcam[calibration]"',
            extra="calibration",
        ) from exc
    version = str(getattr(module, "__version__", ""))
    if name == "cv2" and version.startswith(BROKEN):
        raise MissingExtraError(
            f"calibration needs an OpenCV other than {version}, which lacks hand-eye calibration: "
            'pip install "smartcam[calibration]"',
            extra="calibration",
        )
    return module
