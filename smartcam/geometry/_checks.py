"""Check arguments: a text from a list of choices, and the size of an image."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from smartcam._arguments import as_plain_value, excerpt
from smartcam.geometry._codes import Code

if TYPE_CHECKING:
    from collections.abc import Sequence


def check_choice(value: object, among: Sequence[str], label: str) -> None:
    """Raise SHAPE, the code of wrong arguments, if an option is not in the list of known ones."""
    word = as_plain_value(value)  # a user's str may hash and compare otherwise
    if not isinstance(word, str) or word not in among:
        known = list(among)
        message = f"{label}: expected one of {known}, got {excerpt(value)}"
        raise Code.SHAPE.error(message, known, value)


def check_size(values: Any, label: str) -> None:
    """Raise SHAPE unless a value is an image's width and height, pixels."""
    integers = (int, np.integer)
    is_pair = isinstance(values, tuple | list) and len(values) == 2
    if not is_pair or not all(isinstance(value, integers) and value > 0 for value in values):
        expected = f"{label}: size: expected width and height in pixels"
        raise Code.SHAPE.error_with_value(expected, "(width, height)", values)
