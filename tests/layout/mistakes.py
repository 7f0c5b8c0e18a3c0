"""Mistakes in the layout language and in files of YAML, for tests of the fuzzing targets."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tests.layout.inside import _compiled, _yaml_files, parse_text

if TYPE_CHECKING:
    from collections.abc import Callable


def cannot_tell_lines(mistake: Callable[..., Any]) -> tuple[object, str, Any]:
    """Return the arguments of ``setattr`` that put a mistake for what finds an error's line."""
    return _yaml_files, "_find_line", mistake


CUTS_TEXTS = (_compiled, "parse_text", lambda text, start: parse_text(text[start:]))
"""The text of a layout is cut off where it begins."""
