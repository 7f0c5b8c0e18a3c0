"""Cameras of further makes: ifm by PCIC, Keyence IV2/IV3 and SR; each with its emulated camera.

The core imports none of them: they are found by the schemes of their URLs, ``pcic://``, ``iv3://``
and ``sr://``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.makes._ifm.camera import EmulatedIfm
    from smartcam.makes._keyence.iv3_camera import EmulatedIv3
    from smartcam.makes._keyence.sr_camera import EmulatedSr

__all__ = [
    "EmulatedIfm",
    "EmulatedIv3",
    "EmulatedSr",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_ifm.camera": "EmulatedIfm",
            "_keyence.iv3_camera": "EmulatedIv3",
            "_keyence.sr_camera": "EmulatedSr",
        },
    )
