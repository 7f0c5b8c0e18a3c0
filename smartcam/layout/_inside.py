"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.layout._classes import describes_layout, read_class
    from smartcam.layout._codec import split_rows
    from smartcam.layout._text import SI_SYMBOLS, TYPES, UNITS, Field, misfit_error
    from smartcam.layout._text_cells import pack_texts
    from smartcam.layout._units import ShownUnits, units_of
    from smartcam.layout._yaml_files import file_schema, read_model
    from smartcam.layout._yaml_parsing import BadYamlError, compose, load

__all__ = [
    "SI_SYMBOLS",
    "TYPES",
    "UNITS",
    "BadYamlError",
    "Field",
    "ShownUnits",
    "compose",
    "describes_layout",
    "file_schema",
    "load",
    "misfit_error",
    "pack_texts",
    "read_class",
    "read_model",
    "split_rows",
    "units_of",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_classes": "describes_layout read_class",
            "_codec": "split_rows",
            "_text": "Field SI_SYMBOLS TYPES UNITS misfit_error",
            "_text_cells": "pack_texts",
            "_units": "ShownUnits units_of",
            "_yaml_files": "file_schema read_model",
            "_yaml_parsing": "BadYamlError compose load",
        },
    )
