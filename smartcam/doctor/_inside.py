"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.doctor._context import FrameObserver
    from smartcam.doctor._findings import Finding, summary
    from smartcam.doctor._found import FoundPort
    from smartcam.doctor._probing import CameraAnswer, Trial, locate, no_session, trials
    from smartcam.doctor._search import CameraSearch

__all__ = [
    "CameraAnswer",
    "CameraSearch",
    "Finding",
    "FoundPort",
    "FrameObserver",
    "Trial",
    "locate",
    "no_session",
    "summary",
    "trials",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_found": "FoundPort",
            "_context": "FrameObserver",
            "_findings": "Finding summary",
            "_probing": "CameraAnswer Trial locate no_session trials",
            "_search": "CameraSearch",
        },
    )
