"""Judge a calibration: its quality, its error in millimetres, and the next action.

A calibration is "good" if no warning asks for an action (none is in :data:`CURES`), if the error at
left-out points is known, and if twice that error is at most the allowed error. The user gives the
allowed error; the default is :data:`MAX_ERROR_SHARE` of the field. Loading a calibration that is
not good logs a warning.
"""

from __future__ import annotations

import logging
import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

_log = logging.getLogger(__name__)

MAX_ERROR_SHARE: Final = 0.01
"""Largest allowed error, as a fraction of the field, if the user gives none."""

_ERROR_95_PER_RMS: Final = 2.0
"""Twice an RMS error includes 95 of 100 errors or more, in one direction as well as in three."""


@dataclass(frozen=True, slots=True)
class CalibrationVerdict:
    """A verdict on a calibration, or on the outcome of a wizard's step.

    Attributes:
        level: ``good``, ``poor`` (not good enough), or ``unknown``.
        text: the judgement in words, with the cure.
    """

    level: Literal["good", "poor", "unknown"]
    text: str


class Allowed(NamedTuple):
    """The largest error that is allowed."""

    error: float  # error that 95 of 100 new points may have, mm
    is_from_user: bool  # False: the default, a part of the field

    @classmethod
    def of(cls, error: float | None, field: float) -> Allowed:
        """Return the allowed error: the user's, or a part of the ``field``, both in metres."""
        return cls(1e3 * (MAX_ERROR_SHARE * field if error is None else error), error is not None)

    @property
    def text(self) -> str:
        """The error that is allowed, in words."""
        if self.is_from_user:
            return f"{self.error:.3g} mm are allowed"
        share = f"{100 * MAX_ERROR_SHARE:g} % of the field"
        return f"{self.error:.3g} mm are allowed, {share}, the default"


_DEFAULT_CURE: Final = ("see the warning", "more")
_TOUCH_AGAIN: Final = "touch point {number} again"

CURES: Final[Mapping[Code, tuple[str, str]]] = {
    Code.MIRRORED: ("begin anew with --y-down, or say where the tool points", "more"),
    Code.COLLINEAR: ("touch points that are not in a line", "more"),
    Code.SHORT_LEVER: ("touch points that are farther apart", "more"),
    Code.COINCIDENT: ("a point was touched twice: remove one", "remove"),
    Code.TOO_FEW: ("touch more points", "more"),
    Code.WRONG_ORDER: ("exchange the touches that are named, or touch the points again", "reorder"),
    Code.OUTLIER: (_TOUCH_AGAIN, "redo"),
    Code.NOT_PLANAR: (_TOUCH_AGAIN, "redo"),
    Code.POOR_FIT: (_TOUCH_AGAIN, "redo"),
    Code.SCALE_MISMATCH: ("measure the print, and check the units", "more"),
}
"""For each fault the advice, and the option of a wizard's step that follows the advice. If a
calibration has several faults, the first one in this table counts."""

VIEW_CURES: Final[Mapping[Code, tuple[str, str]]] = {
    Code.REFUTED: ("touches of the sheet are off: is the tip right? Else take more views", "more"),
    Code.SCALE_MISMATCH: ("measure the print", "more"),
    Code.WRONG_LENS: ("calibrate the lens as it is set now", "more"),
    Code.MIRRORED: ("see that no picture is flipped", "more"),
    Code.BAD_VIEW: ("remove view {number}", "remove"),
    Code.POOR_FIT: ("see that nothing moved or slipped; else remove view {number}", "remove"),
    Code.INSUFFICIENT_ROTATION: ("take views that are tilted more to both sides", "more"),
    Code.POSES_TOO_SIMILAR: ("take views that are tilted more to both sides", "more"),
}
"""The table :data:`CURES` for calibrations from views."""


class AdvisedVerdict(NamedTuple):
    """A verdict, and the option of a wizard's step that is advised."""

    verdict: CalibrationVerdict
    # error that 95 of 100 new points may have, mm; None: not good, or not known
    good_for: float | None = None
    option: str = "accept"  # the option that is advised
    number: int | None = None  # number, from 1, of the point or view that the advice is about

    def choose_option(self, options: Iterable[str]) -> str:
        """Return the advised one of ``options``, which is never "accept" for a poor result."""
        return next(choice for choice in (self.option, "redo", "more") if choice in options)

    @property
    def figures(self) -> dict[str, Any]:
        """Fields of a wizard's result that carry the judgement."""
        return {"good_for_mm": self.good_for}


def judge(
    held_out: float | None,
    warnings: Iterable[tuple[Code, str]],
    *,
    worst: int,
    predicted: float | None = None,
    allowed: Allowed,
    cures: Mapping[Code, tuple[str, str]] = CURES,
    advice: str = "touch more points",
    where: str = "",
) -> AdvisedVerdict:
    """Return the judgement of a calibration.

    ``held_out``: RMS error at points that were left out, mm. ``warnings``: codes and texts;
    warnings without a cure do not count. ``worst``: number of the point to blame if a warning names
    none. ``predicted``: RMS error that noise causes, mm; the promised error is never less.
    ``allowed``: largest error that may be promised. ``advice``: work that would show how good the
    calibration is. ``where``: the place for which the promised error holds, as a part of the text.
    """
    texts = dict(reversed(list(warnings)))
    for code in cures:
        if code in texts:
            return poor_judgement(code, texts[code], worst=worst, cures=cures)
    if held_out is None:
        return AdvisedVerdict(
            CalibrationVerdict("unknown", f"Not known how good: {advice}"), option="more"
        )
    good_for = _rounded_up(_ERROR_95_PER_RMS * max(held_out, predicted or 0.0))
    promise = f"95 of 100 new points lie within {good_for:g} mm{where}"
    if good_for > max(allowed.error, _rounded_up(0.0)):
        text = f"Not good enough: {promise}, but {allowed.text}: {advice}"
        return AdvisedVerdict(CalibrationVerdict("poor", text), option="more")
    if Code.SIDE_UNKNOWN in texts:
        text = f"Not known how good: say where the tool points. If y is not mirrored, {promise}"
        return AdvisedVerdict(CalibrationVerdict("unknown", text), option="side")
    text = f"Good for {good_for:g} mm{where}: 95 of 100 new points lie within it; {allowed.text}"
    return AdvisedVerdict(CalibrationVerdict("good", text), good_for)


def poor_judgement(
    code: str,
    text: str,
    *,
    worst: int = 1,
    cures: Mapping[Code, tuple[str, str]] = CURES,
) -> AdvisedVerdict:
    """Return the judgement that a calibration is not good; ``text`` names the fault."""
    point_number = re.search(r"\bpoints? (\d+)", text)
    number = int(point_number[1]) if point_number else worst
    cure, option = next((pair for fault, pair in cures.items() if fault == code), _DEFAULT_CURE)
    verdict = CalibrationVerdict("poor", f"Not good enough: {cure.format(number=number)}")
    return AdvisedVerdict(verdict, option=option, number=number)


def _rounded_up(value: float) -> float:
    """Return a value rounded up to one decimal, or below 0.1 to one digit."""
    digits = 1 if value > 0.1 else -math.floor(math.log10(max(value, 0.001)))
    factor = 10.0**digits
    return max(math.ceil(round(value * factor, 6)), 1) / factor


def doubt_text(calibration: Any) -> str:
    """Return a warning for users of a calibration that is not good, or an empty text.

    A ``calibration`` without a ``verdict`` gives an empty text.
    """
    verdict: CalibrationVerdict | None = getattr(calibration, "verdict", None)
    if verdict is None or verdict.level == "good":
        return ""
    return f"this calibration is not known to be good. {verdict.text}"


def warn_unless_good(calibration: Any, name: str) -> None:
    """Log a warning if the calibration of a file is not known to be good."""
    if doubt := doubt_text(calibration):
        _log.warning("%s: %s", name, doubt)
