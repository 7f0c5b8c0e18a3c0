"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.doctor._context import FrameObserver
    from smartcam.doctor._findings import Finding, summary
    from smartcam.doctor._found import FoundPort
    from smartcam.doctor._probing import CameraAnswer, TracedAttempt, locate, no_session, try_ways
    from smartcam.doctor._search import CameraSearch

__all__ = [
    "CameraAnswer",
    "CameraSearch",
    "Finding",
    "FoundPort",
    "FrameObserver",
    "TracedAttempt",
    "locate",
    "no_session",
    "summary",
    "try_ways",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_found": "FoundPort",
            "_context": "FrameObserver",
            "_findings": "Finding summary",
            "_probing": "CameraAnswer TracedAttempt try_ways locate no_session",
            "_search": "CameraSearch",
        },
    )
