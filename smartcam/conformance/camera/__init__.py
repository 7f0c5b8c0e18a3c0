"""Judge whether a camera is a BVS camera, and observe behaviour that no document describes.

On the command line, with the camera's address::

    pytest --pyargs smartcam.conformance.camera --camera-url bvs://192.168.0.10

In a test file, subclass :class:`CameraConformance`. In a program, :func:`judge` does the same
without pytest. Importing this is light, since names are resolved when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.conformance.camera._judging import judge
    from smartcam.conformance.camera._options import Allow, ConformanceOptions
    from smartcam.conformance.camera._suite import CameraConformance

__all__ = [
    "Allow",
    "CameraConformance",
    "ConformanceOptions",
    "judge",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_judging": "judge",
            "_options": "Allow ConformanceOptions",
            "_suite": "CameraConformance",
        },
    )
