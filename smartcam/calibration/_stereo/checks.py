"""Whether what was found of two cameras can be so."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from smartcam.calibration._codes import Code, Remark
from smartcam.calibration._stereo.start import SIDES
from smartcam.calibration._views import label
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.calibration._geometry.frames import Transform
    from smartcam.calibration._lens.bundle import Sight

WORST: Final = 5.0
"""Pixels rms, beyond which the pairs do not belong together."""

WORST_PART: Final = 0.005
"""The same as a part of the longer side of the image, where that is more."""

WORST_SIGMAS: Final = 20.0
"""The same as a multiple of the points' standard deviation, where that is more."""

UPRIGHT: Final = 1.0
"""Trace of the rotation between cameras that are turned by a right angle."""


def check_fit(rms: float, sights: Sequence[Sight], bad: Sequence[Sight]) -> None:
    """Raise (``POOR_FIT``) where the pairs do not belong together.

    ``rms``: of the residuals, a coordinate, pixels. ``sights``: the used views; ``bad``: those that
    fit worst.
    """
    noise = float(np.median(np.concatenate([one.view.sigmas for one in sights])))
    longer = max(max(one.view.size) for one in sights)
    most = max(WORST, WORST_PART * longer, WORST_SIGMAS * noise)
    if rms <= most:
        return
    named = ", ".join(f"{label(one.view, one.pose)} ({SIDES[one.camera]})" for one in bad)
    raise CalibrationError(
        "stereo: expected cameras that show the pairs as they are, got residuals of "
        f"{rms:.3g} pixels rms, {most:.3g} at most expected: were the views of each pair taken at "
        f"the same moment, and are they in the same order? Those that fit worst: "
        f"{named or 'all alike'}",
        code=Code.POOR_FIT,
        expected=most,
        got=rms,
    )


def remark_sides(transform: Transform) -> list[Remark]:
    """Return a remark where the right camera stands left of the left one, by ``T_right_left``."""
    along = transform.translation
    beside = along[0] > 0 and along[0] == np.abs(along).max()
    if not beside or float(np.trace(transform.rotation)) <= UPRIGHT:
        return []
    return [
        Remark(
            Code.SWAPPED_SIDES,
            "left and right seem swapped: expected the right camera on the right of the left one, "
            f"got it {1e3 * along[0]:.3g} mm on the left; where it is meant so, all is well",
        )
    ]
