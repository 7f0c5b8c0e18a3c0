"""Ask for the target on a sheet, and for the lengths of its printed rulers."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from smartcam.calibration._printing.page_layout import RULER_MM
from smartcam.calibration._printing.sheets import scale_target
from smartcam.calibration._targets import target_from_data, target_to_data
from smartcam.calibration.wizards._sequence import ask
from smartcam.calibration.wizards._steps import Flag, Number, Option, Step, Text
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.calibration._targets import Target
    from smartcam.calibration.wizards._steps import Input

_COUNTS: Final = (
    Number(name="columns", label="Columns", integer=True, minimum=3, maximum=1000),
    Number(name="rows", label="Rows", integer=True, minimum=3, maximum=1000),
)


def _length_input(name: str, label: str, *, optional: bool = False) -> Number:
    return Number(
        name=name, label=label, unit="mm", minimum=0.1, maximum=10_000.0, optional=optional
    )


_INPUTS: Final[Mapping[str, tuple[Input, ...]]] = {
    "checkerboard": (
        *(replace(count, label=f"{count.label} of inner corners") for count in _COUNTS),
        _length_input("square", "Side of a square"),
        Flag(name="origin_mark", label="A black dot marks the origin", default=True),
    ),
    "charuco": (
        *(replace(count, label=f"{count.label} of squares") for count in _COUNTS),
        _length_input("square", "Side of a square"),
        _length_input("marker", "Side of a marker"),
        Text(name="dictionary", label="Dictionary of the markers", default="DICT_5X5_250"),
        Flag(name="legacy_pattern", label="Printed by an OpenCV before 4.6"),
    ),
    "circles": (
        *(replace(count, label=f"{count.label} of dots") for count in _COUNTS),
        _length_input("spacing", "Distance of two dots of a row"),
        _length_input("diameter", "Diameter of a dot"),
        Flag(name="asymmetric", label="Every other row is shifted"),
        _length_input(
            "origin_diameter", "Diameter of the dot at the origin, if larger", optional=True
        ),
    ),
}
"""Inputs for each kind of target, named like the target's attributes; lengths are in mm."""


def ruler_input(name: str, along: str = "") -> Number:
    """Return an input for the length of a printed ruler, mm."""
    return Number(
        name=name,
        label=f"Length of the printed ruler{along}, which should be {RULER_MM:g} mm",
        unit="mm",
        default=RULER_MM,
        minimum=0.5 * RULER_MM,
        maximum=2.0 * RULER_MM,
    )


async def ask_target(
    suggested: Target | None = None, *, known: object = None, square: float | None = None
) -> Target:
    """Ask for the target on the sheet and for its rulers; return the target with printed lengths.

    ``suggested``: default of the question. ``known``: a description of the target; the question is
    then skipped. ``square``: default of a square's side, mm. Raises CalibrationError for a wrong
    description of a target, and for rulers that :func:`~smartcam.calibration.scale_target` refuses.
    """
    if known is None:
        target = await _which_target(suggested, square)
    else:
        target = target_from_data(_require_mapping(known))
    step = Step(
        id="rulers",
        title="Was the sheet printed true to size?",
        description="Printers often change the size. Measure both rulers; leave "
        f"{RULER_MM:g} mm if the lengths that you gave were measured on the paper.",
        inputs=tuple(ruler_input(f"ruler_{axis}", f" along {axis}") for axis in "xy"),
    )
    measured = await ask(step)
    return scale_target(target, (measured["ruler_x"], measured["ruler_y"]))


async def _which_target(suggested: Target | None, square: float | None) -> Target:
    kinds = Option(
        name="kind",
        label="What is printed on the sheet",
        options={
            "described": "the target that is described below",
            "checkerboard": "a checkerboard",
            "charuco": "a ChArUco board: markers in the white squares",
            "circles": "dots in rows and columns",
        },
        default="checkerboard" if suggested is None else "described",
    )
    description = Text(
        name="description",
        label="Description, as smartcam sheet --describe writes it",
        default="" if suggested is None else json.dumps(target_to_data(suggested)),
        max_length=1000,
    )
    step = Step(id="sheet", title="Which sheet lies there?", inputs=(kinds, description))
    answer = await ask(step)
    kind = answer["kind"]
    if kind == "described":
        try:
            data: object = json.loads(answer["description"])
        except (ValueError, RecursionError):
            data = None
        return target_from_data(_require_mapping(data))
    step = Step(id="target", title="What is on it", inputs=_INPUTS[kind])
    answers = await ask(step.with_defaults({"square": square}))
    lengths = {field.name for field in _INPUTS[kind] if isinstance(field, Number) and field.unit}
    values = {
        name: 1e-3 * value if name in lengths and value is not None else value
        for name, value in answers.items()
    }
    return target_from_data({"kind": kind, **values})


def _require_mapping(data: object) -> dict[str, Any]:
    if not isinstance(data, dict):
        message = "expected the description of a target, such as "
        message += '{"kind": "checkerboard", "columns": 9, "rows": 6, "square": 0.025}'
        raise Code.WRONG_ANSWERS.error(message, got={"description": message})
    target: dict[str, Any] = data
    return target
