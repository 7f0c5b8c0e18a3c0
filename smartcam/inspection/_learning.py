"""Learning tolerances from pictures of good parts, and saying in words what was learned."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.inspection._measure.tolerances import UNITS, Tolerance
from smartcam.inspection._program import split_name

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from smartcam.geometry._inside import Array
    from smartcam.inspection._finding import Finding, Inspection

AREA_MARGIN: Final = 0.2
"""Share by which a spot may be smaller or larger than those of the good pictures."""

DIFFERENCE_MARGIN: Final = 1.5
"""Times as many pixels may differ as in the good pictures."""

MIN_VALUES: Final = 5
"""Good pictures with a value that a tolerance is learned from at least: fewer do not tell a wrong
one among them."""

GOOD_SHARE: Final = 0.997
"""Share of all good parts that a learned tolerance has in it."""

CONFIDENCE: Final = 0.95
"""Probability that so many of them are in it, whichever parts the pictures show."""

FAR_SPREADS: Final = 5.0
"""Spreads from the median from which on one of many values is another part's."""

FEW: Final = 8.0
"""Pictures at which that distance is twice as long: the spread of a few values is less sure. Of
5 to 200 pictures of good parts, 2 % at most then have one that is left out (simulated)."""

MAX_NAMED: Final = 5
"""Largest number of pictures that a remark names; it counts the others."""

MAX_DIGITS: Final = 9
"""Decimals of a learned tolerance."""


class Lesson(NamedTuple):
    """The tolerances that good pictures taught.

    Attributes:
        tools: settings of the tools by their keys, with the tolerances that were learned.
        remarks: what was learned from what, in words, a sentence or two for each tool.
    """

    tools: dict[str, dict[str, Any]]
    remarks: list[str]


class _Learned(NamedTuple):
    """Settings that a tool gets, and what is said of them."""

    settings: dict[str, Any]
    remark: str


_NOTHING: Final = _Learned({}, "no picture has a value: all stays as it is.")


def learned(tools: Mapping[str, Mapping[str, Any]], good: Mapping[str, Inspection]) -> Lesson:
    """Return the tools with tolerances by which the good pictures are good.

    A measured value that is far from the others is left out, and the remarks name its picture.

    Args:
        tools: settings of the tools by their keys.
        good: inspections of good pictures by these tools, by the pictures' names.
    """
    found = {key: dict(given) for key, given in tools.items()}
    remarks = []
    for key, settings in found.items():
        kind, name = split_name(key)
        if kind not in _LEARNERS:
            remarks.append(f"{key}: a tool of this kind has no tolerance to learn.")
            continue
        seen = {one: had.findings[name] for one, had in good.items() if name in had.findings}
        asked = {one: had for one, had in seen.items() if had.values or had.records or had.details}
        left_out = {one: had.reason for one, had in seen.items() if one not in asked}
        changes, remark = _LEARNERS[kind](asked, settings) if asked else _NOTHING
        settings.update(changes)
        remarks.append(f"{key}: {remark}{_left_out(left_out)}")
    return Lesson(found, remarks)


def _of_present(seen: Mapping[str, Finding], _settings: Mapping[str, Any]) -> _Learned:
    findings = [*seen.values()]
    counts = [int(one.values.get("count", 0)) for one in findings]
    found: dict[str, Any] = {"count": [min(counts), max(counts)]}
    many = f"{min(counts)} to {max(counts)}" if min(counts) < max(counts) else f"{max(counts)}"
    remark = f"{many} spots in {_pictures(len(seen))}"
    each = [one.records or (one.values,) for one in findings]
    areas = [float(record["area"]) for records in each for record in records if record.get("area")]
    if areas and all(len(records) >= count for records, count in zip(each, counts, strict=True)):
        least, most = (1 - AREA_MARGIN) * min(areas), (1 + AREA_MARGIN) * max(areas)
        found["area"] = [max(1, math.floor(least)), math.ceil(most)]
        remark += (
            f", of {min(areas):.0f} to {max(areas):.0f} pixels; area has {AREA_MARGIN:.0%} more "
            "to both sides"
        )
    elif any(counts):  # of spots that are not in the result nobody knows the area
        remark += "; area stays as it is, as the result does not have all of them (most)"
    return _Learned(found, f"{remark}.")


def _of_compare(seen: Mapping[str, Finding], _settings: Mapping[str, Any]) -> _Learned:
    most = max(int(one.values.get("differing", 0)) for one in seen.values())
    allowed = math.ceil(DIFFERENCE_MARGIN * most)
    remark = f"at most {most} pixels differ in {_pictures(len(seen))}; {allowed} are allowed."
    return _Learned({"allowed": allowed}, remark)


def _of_read(seen: Mapping[str, Finding], _settings: Mapping[str, Any]) -> _Learned:
    texts = {
        str(one["text"])
        for found in seen.values()
        for one in (found.records or (found.values,))
        if one.get("text")
    }
    if len(texts) != 1:
        return _Learned({}, f"{len(texts)} texts in {_pictures(len(seen))}: expect stays as it is.")
    text = texts.pop()
    return _Learned({"expect": re.escape(text)}, f"the text {text!r:.60} in all that was read.")


# ---------------------------------------------------------------------- measured values


def _of_measure(seen: Mapping[str, Finding], settings: Mapping[str, Any]) -> _Learned:
    """Return the tolerance that measured values tell, in the form and unit of the one before."""
    measured = {name: one.details for name, one in seen.items() if _is_number(one.details)}
    left_out = {
        name: one.reason.partition(":")[0] for name, one in seen.items() if name not in measured
    }
    before = settings.get("tolerance")
    old = Tolerance.parse(before) if isinstance(before, str) else None
    unit, factor = _unit(old, next((one.unit for one in measured.values()), "px"))
    values = np.array([one.value for one in measured.values()]) / factor
    sigmas = np.array([one.sigma for one in measured.values()]) / factor
    if unit == "deg":
        values = _on_one_turn(values)
    far = _far(values, sigmas)
    names = np.array([*measured], dtype=object)
    left_out |= {
        name: f"{value:.6g} {unit} is far from the others"
        for name, value in zip(names[far], values[far], strict=True)
    }
    values, sigmas = values[~far], sigmas[~far]
    if len(values) < MIN_VALUES:
        return _Learned(
            {},
            f"expected {MIN_VALUES} good pictures with a value or more, got {len(values)}: the "
            f"tolerance stays as it is.{_left_out(left_out)}",
        )
    guard = float(settings.get("guard", 2.0)) * float(sigmas.max())
    mean, spread = float(values.mean()), float(values.std(ddof=1))
    noise = float(np.sqrt(np.mean(sigmas**2)))
    text = _text(values, max(spread, noise), guard, old, unit)
    remark = (
        f"tolerance {text}, from {_pictures(len(values))}: mean {mean:.6g} {unit}, standard "
        f"deviation {spread:.2g} {unit}, of which measuring makes "
        f"{noise:.2g} {unit}. It has {GOOD_SHARE:.1%} of all such "
        f"parts in it, as far as so few pictures tell.{_left_out(left_out)}"
    )
    return _Learned({"tolerance": text}, remark)


def _is_number(details: Any) -> bool:
    return math.isfinite(details.value) and math.isfinite(details.sigma) if details else False


def _unit(old: Tolerance | None, measured: str) -> tuple[str, float]:
    """Return the unit to write, and how much of the measured one it is."""
    written = measured if old is None else old.written_unit
    name, factor = UNITS[written]
    return (written, factor) if name == measured else (measured, 1.0)


def _on_one_turn(values: Array) -> Array:
    """Return directions in degrees without turns between them."""
    if not len(values):
        return values
    turns = np.array([math.remainder(one - values[0], 360.0) for one in values.tolist()])
    middle = math.remainder(float(values[0] + np.median(turns)), 360.0)
    near: Array = turns - np.median(turns) + middle
    return near


def _far(values: Array, sigmas: Array) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return a mask of the values (N,) that are too far from the others to be of the same part."""
    if not len(values):
        return np.zeros(0, dtype=bool)
    away = np.abs(values - np.median(values))
    # of normal values the median distance is 0.6745 standard deviations
    spread = max(float(np.median(away)) / 0.6745, float(np.median(sigmas)))
    found: np.ndarray[Any, np.dtype[np.bool_]] = (
        away > FAR_SPREADS * (1 + FEW / len(values)) * spread
    )
    return found


def _text(values: Array, spread: float, guard: float, old: Tolerance | None, unit: str) -> str:
    """Return the tolerance of values (N,), to one side where the one before was."""
    mean, sided = float(values.mean()), old is not None and math.inf in (-old.least, old.most)
    wide = _spreads(len(values), sided=sided) * spread
    half = max(wide, float(np.abs(values - mean).max())) + guard
    digits = min(max(1 - math.floor(math.log10(half)), 0), MAX_DIGITS) if half > 0 else 3
    step = 10.0**-digits

    def out(value: float) -> float:
        return (math.floor(value / step) + 1) * step

    if sided and old is not None and old.least == -math.inf:
        return f"at most {out(mean + half):.{digits}f} {unit}"
    if sided:
        return f"at least {-out(-(mean - half)):.{digits}f} {unit}"
    middle = round(mean, digits)
    return f"{middle:.{digits}f} +- {out(half + abs(middle - mean)):.{digits}f} {unit}"


def _spreads(number: int, *, sided: bool) -> float:
    """Return the standard deviations of so many normal values that have most parts in them.

    By Howe to both sides, which is Natrella's approximation to one side.
    """
    special = load("scipy.special", "teaching measure needs")
    degrees = number - 1
    if sided:
        share, sure = (float(special.ndtri(one)) for one in (GOOD_SHARE, CONFIDENCE))
        a, b = 1 - sure**2 / (2 * degrees), share**2 - sure**2 / number
        return (share + math.sqrt(share**2 - a * b)) / a
    share = float(special.ndtri((1 + GOOD_SHARE) / 2))
    least = float(special.chdtri(degrees, CONFIDENCE))  # chi squared that is seldom below it
    return share * math.sqrt(degrees * (1 + 1 / number) / least)


def _left_out(left_out: Mapping[str, str]) -> str:
    """Return the sentence about pictures that nothing was learned from; "" if there are none."""
    if not left_out:
        return ""
    named = [f"{name} ({why})" for name, why in left_out.items()][:MAX_NAMED]
    more = f" and {len(left_out) - MAX_NAMED} more" if len(left_out) > MAX_NAMED else ""
    return f" Not learned from: {', '.join(named)}{more}."


def _pictures(number: int) -> str:
    return "1 picture" if number == 1 else f"{number} pictures"


_LEARNERS: Final[dict[str, Callable[[Mapping[str, Finding], Mapping[str, Any]], _Learned]]] = {
    "compare": _of_compare,
    "measure": _of_measure,
    "present": _of_present,
    "read": _of_read,
}
