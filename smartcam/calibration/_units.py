"""Convert units of length, which a file, its format or the user names; they are never guessed.

Programs write the same files in metres and in millimetres. If neither the file nor its format names
the unit, the user has to. Even with a unit, values that are too large for a robot's cell are
refused, and the error asks whether they are in another unit.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, Literal, TypeAlias

from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from smartcam.exceptions import CalibrationError

LengthUnit: TypeAlias = Literal["m", "cm", "mm", "inch"]
"""Names of units of length."""

METRES_PER_UNIT: Final[Mapping[str, float]] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
"""Metres per unit."""

MAX_PLAUSIBLE_M: Final = 20.0
"""Largest distance, metres, from one frame to another or from a sensor to a point, for which the
unit need not be confirmed: a robot's cell is smaller than 20 m, and millimetres that are taken for
metres exceed it from 20 mm on."""

MAX_ANGLE: Final = 2 * math.pi + 1e-3
"""A larger angle, radians, is taken for degrees."""


def metres_of(unit: object, label: str) -> float:
    """Return the metres per unit, or raise UNIT_UNKNOWN; ``label`` names the lengths."""
    if not isinstance(unit, str) or unit not in METRES_PER_UNIT:
        raise Code.UNIT_UNKNOWN.error(
            f"{label}: expected a unit of length of {', '.join(METRES_PER_UNIT)}, got {unit!r}",
            list(METRES_PER_UNIT),
            unit,
        )
    return METRES_PER_UNIT[unit]


def no_unit_error(label: str) -> CalibrationError:
    """Return the error about a file that may be in metres or in millimetres."""
    return Code.UNIT_UNKNOWN.error(
        f"{label}: expected to know the unit of its lengths, which neither the file nor its format "
        'says; give it as unit="m" or unit="mm", or as --unit on the command line',
        list(METRES_PER_UNIT),
    )


def check_length(metres: float, label: str) -> None:
    """Raise UNIT_UNKNOWN for a length, metres, that does not occur in a robot's cell."""
    if metres > MAX_PLAUSIBLE_M:
        raise Code.UNIT_UNKNOWN.error(
            f"{label}: expected at most {MAX_PLAUSIBLE_M:g} m, got {metres:g} m; is it in "
            'millimetres? Give unit="mm" then, or unit="m" if it is not',
            MAX_PLAUSIBLE_M,
            metres,
        )


def check_angles(radians: Sequence[float], label: str) -> None:
    """Raise UNIT_UNKNOWN for angles of more than a whole turn."""
    largest = max(map(abs, radians))
    if largest > MAX_ANGLE:
        raise Code.UNIT_UNKNOWN.error(
            f"{label}: expected angles in radians, a whole turn at most, got {largest:g}; are they "
            "in degrees? Multiply them by pi / 180",
            2 * math.pi,
            largest,
        )
