"""Verdicts on what came out: whether it is good, for how many millimetres, and what to do next."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from smartcam.calibration._codes import Code
from smartcam.calibration.wizards._steps import StepVerdict

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

_WITHIN: Final = 2.0
"""Twice an rms error holds 95 of 100 errors or more, in one direction as in three."""

_LOOK: Final = ("see the warning", "more")
_AGAIN: Final = "touch point {number} again"

CURES: Final[Mapping[Code, tuple[str, str]]] = {
    Code.MIRRORED: ("begin anew with --y-down, or say where the tool points", "more"),
    Code.COLLINEAR: ("touch points that are not in a line", "more"),
    Code.SHORT_LEVER: ("touch points that are farther apart", "more"),
    Code.COINCIDENT: ("a point was touched twice: remove one", "remove"),
    Code.TOO_FEW: ("touch more points", "more"),
    Code.OUTLIER: (_AGAIN, "redo"),
    Code.NOT_PLANAR: (_AGAIN, "redo"),
    Code.POOR_FIT: (_AGAIN, "redo"),
    Code.SCALE_MISMATCH: ("measure the print, and check the units", "more"),
}
"""What to do, and the option that does it, by what is wrong; the first that applies counts."""

VIEW_CURES: Final[Mapping[Code, tuple[str, str]]] = {
    Code.SCALE_MISMATCH: ("measure the print", "more"),
    Code.BAD_VIEW: ("remove view {number}", "remove"),
    Code.POOR_FIT: ("remove view {number}", "remove"),
    Code.INSUFFICIENT_ROTATION: ("take views that are tilted more to both sides", "more"),
    Code.POSES_TOO_SIMILAR: ("take views that are tilted more to both sides", "more"),
}
"""The same for views."""


class Judgement(NamedTuple):
    """A verdict, and what is advisable."""

    verdict: StepVerdict
    good_for: float | None = None  # mm, of 95 of 100 new points; None: not good, or not known
    option: str = "accept"  # the advisable one
    number: int | None = None  # the point or view that it is about, from 1

    def chosen(self, options: Iterable[str]) -> str | None:
        """Return the advisable one of some options; None: the first of them."""
        return self.option if self.option in options else None

    @property
    def figures(self) -> dict[str, Any]:
        """What a wizard's result says of it."""
        return {"good_for_mm": self.good_for}


def judge(
    held_out: float | None,
    wrong: Iterable[tuple[Code, str]],
    *,
    worst: int,
    predicted: float | None = None,
    cures: Mapping[Code, tuple[str, str]] = CURES,
    more: str = "touch more points",
    where: str = "",
) -> Judgement:
    """Return what a calibration is worth.

    ``held_out``: rms error at points that were left out, mm. ``wrong``: warnings; those that have
    no cure do not count. ``worst``: number of the point to blame where a warning names none.
    ``predicted``: rms error that noise leads to, mm; what is promised is not below it. ``more``:
    what tells how good it is. ``where``: of what the promise is, for people.
    """
    texts = dict(reversed(list(wrong)))
    for code in cures:
        if code in texts:
            return refused(code, texts[code], worst=worst, cures=cures)
    if held_out is None:
        return Judgement(StepVerdict("unknown", f"Not known how good: {more}"), option="more")
    good_for = _rounded_up(_WITHIN * max(held_out, predicted or 0.0))
    text = f"Good for {good_for:g} mm{where}: 95 of 100 new points lie within it"
    return Judgement(StepVerdict("good", text), good_for)


def refused(
    code: str,
    text: str,
    *,
    worst: int = 1,
    cures: Mapping[Code, tuple[str, str]] = CURES,
) -> Judgement:
    """Return that it is not good, and what to do about it. ``text`` says what is wrong."""
    named = re.search(r"\bpoint (\d+)", text)
    number = int(named[1]) if named else worst
    cure, option = next((how for one, how in cures.items() if one == code), _LOOK)
    said = StepVerdict("poor", f"Not good enough: {cure.format(number=number)}")
    return Judgement(said, option=option, number=number)


def _rounded_up(value: float) -> float:
    """Return it with one decimal, of less than 0.1 with one digit; what is rounded is larger."""
    digits = 1 if value > 0.1 else -math.floor(math.log10(max(value, 0.001)))
    factor = 10.0**digits
    return max(math.ceil(round(value * factor, 6)), 1) / factor
