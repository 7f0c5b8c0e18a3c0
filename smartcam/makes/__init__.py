"""Cameras of further makes: ifm by PCIC, Keyence IV2/IV3 and SR; each with its emulated camera.

The core imports none of them: they are found by the schemes of their URLs, ``pcic://``, ``iv3://``
and ``sr://``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.makes._ifm.camera import EmulatedIfm
    from smartcam.makes._ifm.chunks import ImageChunk, read_chunks
    from smartcam.makes._ifm.dialect import PCIC
    from smartcam.makes._keyence.iv3 import IV3
    from smartcam.makes._keyence.iv3_camera import EmulatedIv3
    from smartcam.makes._keyence.sr import SR
    from smartcam.makes._keyence.sr_camera import EmulatedSr

__all__ = [
    "IV3",
    "PCIC",
    "SR",
    "EmulatedIfm",
    "EmulatedIv3",
    "EmulatedSr",
    "ImageChunk",
    "read_chunks",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_ifm.camera": "EmulatedIfm",
            "_ifm.chunks": "ImageChunk read_chunks",
            "_ifm.dialect": "PCIC",
            "_keyence.iv3": "IV3",
            "_keyence.iv3_camera": "EmulatedIv3",
            "_keyence.sr": "SR",
            "_keyence.sr_camera": "EmulatedSr",
        },
    )
