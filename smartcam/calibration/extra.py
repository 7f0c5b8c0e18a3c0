"""What the extra ``calibration`` brings, imported where it is first used."""

from __future__ import annotations

import importlib
from typing import Any

from smartcam.exceptions import MissingExtraError

__all__ = ["load"]


def load(name: str) -> Any:
    """Return a module of SciPy or OpenCV; untyped, which is why it is any.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as exc:
        raise MissingExtraError(
            f'calibration needs {name.partition(".")[0]}: pip install "smartcam[calibration]"',
            extra="calibration",
        ) from exc
