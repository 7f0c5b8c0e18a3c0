"""A cell that sorts bolts by what a smart camera says of them.

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
    """What became of the bolts.

    Attributes:
        good: lengths of the good ones, metres.
        scrap: how many were bad.
        unseen: of how many the camera said nothing that counts; they go round again.
    """

    good: list[float] = field(default_factory=list)
    scrap: int = 0
    unseen: int = 0


async def sort_bolts(camera: Camera, count: int, *, timeout: float = 2.0) -> Tally:
    """Look at so many bolts; a bolt without a result is never taken for a good one.

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
