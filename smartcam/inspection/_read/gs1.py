"""Split GS1 element strings into application identifiers and values.

GS1 General Specifications, 7.8: an element whose first two digits are in the table of predefined
lengths has that length; every other element ends at GS or at the end.
"""

from __future__ import annotations

from typing import Final

GS: Final = "\x1d"

_PREDEFINED: Final = {
    "00": 20,
    "01": 16,
    "02": 16,
    "03": 16,
    "04": 18,
    "20": 4,
    "41": 16,
    **{str(number): 8 for number in range(11, 20)},
    **{str(number): 10 for number in range(31, 37)},
}
"""Length of an element with its identifier, in characters, by the first two digits."""

_IDENTIFIER_DIGITS: Final = {
    **dict.fromkeys(["23", "24", "25", "40", "41", "42", "71"], 3),
    **dict.fromkeys(["31", "32", "33", "34", "35", "36", "39", "43", "70", "72"], 4),
    **dict.fromkeys(["80", "81", "82"], 4),
}
"""Number of digits of an application identifier by its first two; 2 for all others."""


def split_elements(text: str) -> tuple[tuple[str, str], ...]:
    """Return application identifier and value of each element.

    At an element that is too short, or whose identifier is no number, splitting ends: the rest of
    the text is the last value, with the identifier "".
    """
    elements: list[tuple[str, str]] = []
    start = 1 if text.startswith(GS) else 0
    while start < len(text):
        digits = _IDENTIFIER_DIGITS.get(text[start : start + 2], 2)
        identifier = text[start : start + digits]
        length = _PREDEFINED.get(text[start : start + 2])
        longest_end = len(text) if length is None else min(start + length, len(text))
        end = text.find(GS, start, longest_end)
        end = longest_end if end < 0 else end
        stop = end if length is None else start + length
        if not (identifier.isascii() and identifier.isdigit()) or not start + digits < stop <= end:
            elements.append(("", text[start:]))
            break
        elements.append((identifier, text[start + digits : stop]))
        start = stop + 1 if text[stop : stop + 1] == GS else stop
    return tuple(elements)
