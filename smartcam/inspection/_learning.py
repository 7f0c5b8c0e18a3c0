"""Compute the tools' tolerances from pictures of good parts, and explain each in a sentence."""

from __future__ import annotations

import itertools
import math
import re
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from smartcam._extras import load
from smartcam.inspection._measure.tolerances import UNITS, Tolerance
from smartcam.inspection._program import split_tool_key

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from smartcam.geometry._inside import Array
    from smartcam.inspection._finding import Finding, Inspection

AREA_MARGIN: Final = 0.2
"""Share by which the area of a spot may be below the smallest, or above the largest, spot of the
good pictures."""

DIFFERENCE_MARGIN: Final = 1.5
"""Ratio of the allowed number of differing pixels to the largest number in a good picture."""

MIN_VALUES: Final = 5
"""Least number of good pictures with a measured value from which a tolerance is learned; among
fewer values, outliers cannot be found."""

TOLERANCE_COVERAGE: Final = 0.997
"""Share of all good parts that a learned tolerance contains."""

CONFIDENCE: Final = 0.95
"""Probability, over all samples of good parts, that a learned tolerance contains
``TOLERANCE_COVERAGE`` of the good parts."""

OUTLIER_SPREADS: Final = 5.0
"""Distance from the median, in standard deviations, beyond which a value of a large sample is an
outlier."""

DOUBLE_LIMIT_VALUES: Final = 8.0
"""Number of values at which the limit for outliers is twice ``OUTLIER_SPREADS``, since the spread
of few values is uncertain. In simulations with 5 to 200 good parts, at most 2 % of the samples lose
a good value."""

MAX_PICTURES_IN_REMARK: Final = 5
"""Largest number of pictures that a remark names; further pictures are only counted."""

MAX_DIGITS: Final = 9
"""Largest number of decimals of a learned tolerance."""


class Lesson(NamedTuple):
    """Tolerances that were learned from good pictures.

    Attributes:
        tools: settings of the tools by their keys, with the learned tolerances.
        remarks: a text for each tool that explains the tool's new tolerance.
    """

    tools: dict[str, dict[str, Any]]
    remarks: list[str]


class _Learned(NamedTuple):
    """New settings of a tool, and a sentence that explains them."""

    settings: dict[str, Any]
    remark: str


_NO_VALUES: Final = _Learned({}, "no picture has a value: all settings stay as they are.")


def learn_tolerances(
    tools: Mapping[str, Mapping[str, Any]], good: Mapping[str, Inspection]
) -> Lesson:
    """Return the tools with tolerances that accept the good pictures.

    Outliers among measured values are left out, and the remarks name their pictures.

    Args:
        tools: settings of the tools by their keys.
        good: inspections of good pictures by these tools, with the pictures' names as keys.
    """
    learned_tools = {key: dict(given) for key, given in tools.items()}
    remarks = []
    for key, settings in learned_tools.items():
        kind, name = split_tool_key(key)
        if kind not in _LEARNERS:
            remarks.append(f"{key}: a tool of this kind has no tolerance to learn.")
            continue
        seen = {
            picture: inspection.findings[name]
            for picture, inspection in good.items()
            if name in inspection.findings
        }
        measured = {
            picture: finding
            for picture, finding in seen.items()
            if finding.values or finding.records or finding.details
        }
        left_out = {
            picture: finding.reason for picture, finding in seen.items() if picture not in measured
        }
        changes, remark = _LEARNERS[kind](measured, settings) if measured else _NO_VALUES
        settings.update(changes)
        remarks.append(f"{key}: {remark}{_left_out_text(left_out)}")
    return Lesson(learned_tools, remarks)


def _learn_present(seen: Mapping[str, Finding], _settings: Mapping[str, Any]) -> _Learned:
    findings = [*seen.values()]
    counts = [int(finding.values.get("count", 0)) for finding in findings]
    tolerances: dict[str, Any] = {"count": [min(counts), max(counts)]}
    counts_text = (
        f"{min(counts)} to {max(counts)}" if min(counts) < max(counts) else f"{max(counts)}"
    )
    remark = (
        f"{counts_text} spots in {'each of ' if len(seen) > 1 else ''}{_pictures_text(len(seen))}"
    )
    spots = [finding.records or (finding.values,) for finding in findings]  # of each picture
    areas = [float(spot["area"]) for spot in itertools.chain(*spots) if spot.get("area")]
    if areas and all(len(listed) >= count for listed, count in zip(spots, counts, strict=True)):
        min_area, max_area = (1 - AREA_MARGIN) * min(areas), (1 + AREA_MARGIN) * max(areas)
        tolerances["area"] = [max(1, math.floor(min_area)), math.ceil(max_area)]
        remark += (
            f", of {min(areas):.0f} to {max(areas):.0f} pixels; area allows {AREA_MARGIN:.0%} less "
            "and more"
        )
    elif any(counts):  # the area of spots outside of the result is unknown
        remark += (
            "; the setting `area` stays as it is, since the setting `most` leaves some of them out "
            "of the result"
        )
    return _Learned(tolerances, f"{remark}.")


def _learn_compare(seen: Mapping[str, Finding], _settings: Mapping[str, Any]) -> _Learned:
    max_differing = max(int(finding.values.get("differing", 0)) for finding in seen.values())
    allowed = math.ceil(DIFFERENCE_MARGIN * max_differing)
    pictures = _pictures_text(len(seen))
    remark = f"at most {max_differing} pixels differ in {pictures}; {allowed} are allowed."
    return _Learned({"allowed": allowed}, remark)


def _learn_read(seen: Mapping[str, Finding], _settings: Mapping[str, Any]) -> _Learned:
    texts = {
        str(record["text"])
        for finding in seen.values()
        for record in (finding.records or (finding.values,))
        if record.get("text")
    }
    if len(texts) != 1:
        return _Learned(
            {},
            f"{len(texts)} texts in {_pictures_text(len(seen))}: the setting `expect` stays as it "
            "is.",
        )
    text = texts.pop()
    return _Learned({"expect": re.escape(text)}, f"the text {text!r:.60} in all that was read.")


# ---------------------------------------------------------------------- measured values


def _learn_measure(seen: Mapping[str, Finding], settings: Mapping[str, Any]) -> _Learned:
    """Return the tolerance of measured values, in the form and unit of the old tolerance."""
    measured = {
        name: finding.details for name, finding in seen.items() if _is_finite(finding.details)
    }
    left_out = {
        name: finding.reason.partition(":")[0]
        for name, finding in seen.items()
        if name not in measured
    }
    old_text = settings.get("tolerance")
    old = Tolerance.parse(old_text) if isinstance(old_text, str) else None
    unit, factor = _choose_unit(
        old, next((measurement.unit for measurement in measured.values()), "px")
    )
    values = np.array([measurement.value for measurement in measured.values()]) / factor
    sigmas = np.array([measurement.sigma for measurement in measured.values()]) / factor
    if unit == "deg":
        values = _unwrap_degrees(values)
    is_outlier = _find_outliers(values, sigmas)
    names = np.array([*measured], dtype=object)
    left_out |= {
        name: f"{value:.6g} {unit} is far from the others"
        for name, value in zip(names[is_outlier], values[is_outlier], strict=True)
    }
    values, sigmas = values[~is_outlier], sigmas[~is_outlier]
    if len(values) < MIN_VALUES:
        return _Learned(
            {},
            f"expected at least {MIN_VALUES} good pictures with a value, got {len(values)}: the "
            f"setting `tolerance` stays as it is.{_left_out_text(left_out)}",
        )
    guard = float(settings.get("guard", 2.0)) * float(sigmas.max())
    mean, spread = float(values.mean()), float(values.std(ddof=1))
    noise = float(np.sqrt(np.mean(sigmas**2)))
    text = _tolerance_text(values, max(spread, noise), guard, old, unit)
    remark = (
        f"tolerance {text}, from {_pictures_text(len(values))}: mean {mean:.6g} {unit}, standard "
        f"deviation {spread:.2g} {unit}, of which the measurement causes "
        f"{noise:.2g} {unit}. The tolerance contains {TOLERANCE_COVERAGE:.1%} of all such "
        f"parts, with a confidence of {CONFIDENCE:.0%}.{_left_out_text(left_out)}"
    )
    return _Learned({"tolerance": text}, remark)


def _is_finite(details: Any) -> bool:
    return math.isfinite(details.value) and math.isfinite(details.sigma) if details else False


def _choose_unit(old: Tolerance | None, measured_unit: str) -> tuple[str, float]:
    """Return the unit of the new tolerance, and the number of measured units in this unit."""
    written = measured_unit if old is None else old.written_unit
    name, factor = UNITS[written]
    return (written, factor) if name == measured_unit else (measured_unit, 1.0)


def _unwrap_degrees(values: Array) -> Array:
    """Return directions in degrees, shifted by multiples of 360 so that they lie close together."""
    if not len(values):
        return values
    turns = np.array([math.remainder(angle - values[0], 360.0) for angle in values.tolist()])
    middle = math.remainder(float(values[0] + np.median(turns)), 360.0)
    unwrapped: Array = turns - np.median(turns) + middle
    return unwrapped


def _find_outliers(values: Array, sigmas: Array) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Return a mask of the outliers among values (N,)."""
    if not len(values):
        return np.zeros(0, dtype=bool)
    distances = np.abs(values - np.median(values))
    # for normal values the median distance is 0.6745 standard deviations
    spread = max(float(np.median(distances)) / 0.6745, float(np.median(sigmas)))
    is_outlier: np.ndarray[Any, np.dtype[np.bool_]] = (
        distances > OUTLIER_SPREADS * (1 + DOUBLE_LIMIT_VALUES / len(values)) * spread
    )
    return is_outlier


def _tolerance_text(
    values: Array, spread: float, guard: float, old: Tolerance | None, unit: str
) -> str:
    """Return the text of a tolerance for values (N,), one-sided if the old tolerance is."""
    mean = float(values.mean())
    one_sided = old is not None and math.inf in (-old.min_value, old.max_value)
    sigma_width = _tolerance_factor(len(values), one_sided=one_sided) * spread
    half = max(sigma_width, float(np.abs(values - mean).max())) + guard
    digits = min(max(1 - math.floor(math.log10(half)), 0), MAX_DIGITS) if half > 0 else 3
    step = 10.0**-digits

    def round_outwards(value: float) -> float:
        return (math.floor(value / step) + 1) * step

    if one_sided and old is not None and old.min_value == -math.inf:
        return f"at most {round_outwards(mean + half):.{digits}f} {unit}"
    if one_sided:
        return f"at least {-round_outwards(-(mean - half)):.{digits}f} {unit}"
    middle = round(mean, digits)
    return f"{middle:.{digits}f} +- {round_outwards(half + abs(middle - mean)):.{digits}f} {unit}"


def _tolerance_factor(count: int, *, one_sided: bool) -> float:
    """Return the half width of a tolerance from ``count`` normal values, in standard deviations.

    The formula is Howe's for a two-sided tolerance, and Natrella's for a one-sided one.
    """
    special = load("scipy.special", "teaching measure needs")
    degrees = count - 1
    if one_sided:
        # quantiles of the normal distribution
        z_coverage, z_confidence = (
            float(special.ndtri(probability)) for probability in (TOLERANCE_COVERAGE, CONFIDENCE)
        )
        a, b = 1 - z_confidence**2 / (2 * degrees), z_coverage**2 - z_confidence**2 / count
        return (z_coverage + math.sqrt(z_coverage**2 - a * b)) / a
    z_coverage = float(special.ndtri((1 + TOLERANCE_COVERAGE) / 2))
    chi_squared = float(special.chdtri(degrees, CONFIDENCE))  # lower quantile of chi squared
    return z_coverage * math.sqrt(degrees * (1 + 1 / count) / chi_squared)


def _left_out_text(left_out: Mapping[str, str]) -> str:
    """Return the sentence about pictures that were left out; "" if there are none."""
    if not left_out:
        return ""
    named_pictures = [f"{name} ({reason})" for name, reason in left_out.items()]
    more_text = (
        f" and {len(left_out) - MAX_PICTURES_IN_REMARK} more"
        if len(left_out) > MAX_PICTURES_IN_REMARK
        else ""
    )
    return f" Not learned from: {', '.join(named_pictures[:MAX_PICTURES_IN_REMARK])}{more_text}."


def _pictures_text(count: int) -> str:
    return "1 picture" if count == 1 else f"{count} pictures"


_LEARNERS: Final[dict[str, Callable[[Mapping[str, Finding], Mapping[str, Any]], _Learned]]] = {
    "compare": _learn_compare,
    "measure": _learn_measure,
    "present": _learn_present,
    "read": _learn_read,
}
