"""A cell that sorts bolts by a smart camera's results.

The camera's application 11 sends whether a bolt is good, its length and what is stamped on it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import smartcam

if TYPE_CHECKING:
    from smartcam import Camera

__all__ = ["APPLICATION", "LAYOUT", "Tally", "sort_bolts"]

APPLICATION = 11
LAYOUT = "ok: bool, length: real32 mm, code: string[12]"


@dataclass
class Tally:
    """Numbers of sorted bolts.

    Attributes:
        good: lengths of the good bolts, metres.
        scrap: number of bad bolts.
        unseen: number of bolts without a valid result; they go round again.
    """

    good: list[float] = field(default_factory=list)
    scrap: int = 0
    unseen: int = 0


async def sort_bolts(camera: Camera, count: int, *, timeout: float = 2.0) -> Tally:
    """Inspect ``count`` bolts; a bolt without a result never counts as good.

    Raises:
        smartcam.LinkError: the camera is gone.
    """
    tally = Tally()
    for _ in range(count):
        try:
            result = await camera.trigger(timeout=timeout)
        except (smartcam.TriggerError, smartcam.InterpretationError):
            tally.unseen += 1
            continue
        bolt = result.value
        if bolt.ok:
            tally.good.append(bolt.length)
        else:
            tally.scrap += 1
    return tally
