"""Parse tolerances such as ``12.00 +- 0.05 mm``."""

from __future__ import annotations

import math
import re
from typing import Final, NamedTuple

from smartcam._arguments import check_text
from smartcam.exceptions import ConfigurationError

UNITS: Final = {
    "mm": ("mm", 1.0),
    "um": ("mm", 1e-3),
    "cm": ("mm", 10.0),
    "m": ("mm", 1e3),
    "inch": ("mm", 25.4),
    "px": ("px", 1.0),
    "deg": ("deg", 1.0),
}
"""Units of a tolerance: the unit of the measurement, and the factor into it."""

_NUMBER = r"(\d{1,12}(?:\.\d{0,12})?|\.\d{1,12})"
_SIGNED = rf"([+-]?\s?{_NUMBER})"
_FORMS: Final = (
    ("both", re.compile(rf"{_SIGNED}\s*(?:\+-|\+/-|±)\s*{_NUMBER}")),
    ("upper_first", re.compile(rf"{_SIGNED}\s*\+\s*{_NUMBER}\s*-\s*{_NUMBER}")),
    ("lower_first", re.compile(rf"{_SIGNED}\s*-\s*{_NUMBER}\s*\+\s*{_NUMBER}")),
    ("between", re.compile(rf"{_SIGNED}\s*to\s*{_SIGNED}")),
    ("most", re.compile(rf"(?:at most|<=|≤)\s*{_SIGNED}")),
    ("least", re.compile(rf"(?:at least|>=|≥)\s*{_SIGNED}")),
)

_LETTERS: Final = "abcdefghijklmnopqrstuvwxyz"

EXPECTED: Final = (
    "expected a tolerance such as '12.00 +- 0.05 mm', '12 +0.1 -0.05 mm', '11.9 to 12.1 mm', "
    "'at most 12.1 mm' or 'at least 11.9 mm', in mm, um, cm, m, inch, px or deg"
)


class Tolerance(NamedTuple):
    """The limits of a value.

    Attributes:
        min_value: smallest good value; minus infinity: no limit.
        max_value: largest good value; infinity: no limit.
        unit: unit of the limits: ``mm``, ``px`` or ``deg``.
        text: original text.
    """

    min_value: float
    max_value: float
    unit: str
    text: str

    @classmethod
    def parse(cls, text: str) -> Tolerance:
        """Return the tolerance of a text.

        Raises:
            ConfigurationError: the text is no tolerance, or has the larger limit first.
        """
        plain = check_text(text, "tolerance", most=100).strip()
        unit = plain[len(plain.rstrip(_LETTERS)) :]
        body = plain[: len(plain) - len(unit)]
        if unit not in UNITS:
            raise ConfigurationError(f"{EXPECTED}; got {plain!r}")
        for form, pattern in _FORMS:
            match = pattern.fullmatch(body.strip())
            if match is not None:
                low, high = _limits(form, match)
                break
        else:
            raise ConfigurationError(f"{EXPECTED}; got {plain!r}")
        if not low <= high:
            raise ConfigurationError(f"tolerance: expected the smaller limit first, got {plain!r}")
        name, factor = UNITS[unit]
        return cls(low * factor, high * factor, name, plain)

    @property
    def written_unit(self) -> str:
        """Unit in the text, one of :data:`UNITS`."""
        return self.text[len(self.text.rstrip(_LETTERS)) :]

    def complaint(self, value: float, sigma: float, guard: float) -> str:
        """Return the reason why a value is not good; "" if it is good.

        The value must be inside the limits by ``guard`` times its sigma; nearer to a limit, the
        true value may be outside. Degrees are compared modulo 360.
        """
        if self.unit == "deg" and all(map(math.isfinite, (self.min_value, self.max_value, value))):
            middle = (self.min_value + self.max_value) / 2
            value = middle + math.remainder(value - middle, 360.0)
        digits = digits_of(sigma)
        shown = f"{value:.{digits}f} {self.unit}"
        if value > self.max_value:
            return f"{shown} is above {self.max_value:.{digits}f} {self.unit}"
        if value < self.min_value:
            return f"{shown} is below {self.min_value:.{digits}f} {self.unit}"
        # also true for NaN
        if not min(self.max_value - value, value - self.min_value) >= guard * sigma:
            return f"{shown} is too near to the limit: sigma is {sigma:.2g} {self.unit}"
        return ""


def _limits(form: str, match: re.Match[str]) -> tuple[float, float]:
    if form in {"most", "least"}:
        limit = _number(match[1])
        return (-math.inf, limit) if form == "most" else (limit, math.inf)
    first = _number(match[1])
    if form == "between":
        return first, _number(match[3])
    if form == "both":
        return first - float(match[3]), first + float(match[3])
    above, below = float(match[3]), float(match[4])
    if form == "lower_first":
        above, below = below, above
    return first - below, first + above


def _number(text: str) -> float:
    return float(text.replace(" ", ""))


def digits_of(sigma: float) -> int:
    """Return the number of decimals that shows two digits of a sigma."""
    if not 0 < sigma < math.inf:
        return 3
    return min(max(1 - math.floor(math.log10(sigma)), 0), 6)
