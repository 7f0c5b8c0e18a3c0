"""Is this a BVS camera, and how does it do what the documents leave open?

On the command line, with the camera's address::

    pytest --pyargs smartcam.conformance.camera --camera-url bvs://192.168.0.10

In a test file, :class:`CameraConformance` is subclassed. In a program, :func:`judge` does the same
without pytest. Names are resolved when they are first used: importing this is light.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from smartcam.conformance.camera.judging import judge
    from smartcam.conformance.camera.options import Allow, Plan
    from smartcam.conformance.camera.pytest_options import add_options
    from smartcam.conformance.camera.report import Report
    from smartcam.conformance.camera.suite import CameraConformance

__all__ = ["Allow", "CameraConformance", "Plan", "Report", "add_options", "judge"]

_HOMES = {
    "Allow": "options",
    "CameraConformance": "suite",
    "Plan": "options",
    "Report": "report",
    "add_options": "pytest_options",
    "judge": "judging",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'smartcam.conformance.camera' has no attribute {name!r}")
    value: Any = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
