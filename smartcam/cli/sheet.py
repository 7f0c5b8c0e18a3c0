"""``smartcam sheet``: a sheet with a target, to print."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from smartcam.cli.options import Options, output_options
from smartcam.cli.running import run
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["sheet"]

F = TypeVar("F", bound="Callable[..., Any]")

DIGITS = 9
"""Of a length in metres: nanometres."""


@click.group()
def sheet() -> None:
    """Make a sheet to print: a target to scale, rays A and B from its origin, rulers.

    Lengths are in millimetres. Print at 100 %, then measure both rulers: printers scale.
    """


def _length(*names: str, about: str, **more: Any) -> Callable[[F], F]:
    kind = click.FloatRange(min=0, min_open=True, max=10_000)
    return click.option(*names, type=kind, metavar="MM", help=about, **more)


def _count(name: str, about: str) -> Callable[[F], F]:
    return click.option(name, type=click.IntRange(3, 1000), required=True, help=about)


def _outputs(function: F) -> F:
    """Decorate a command with what all sheets share."""
    for option in (
        output_options,
        click.option(
            "--measured-ruler",
            "measured",
            nargs=2,
            type=float,
            metavar="X Y",
            help="How long the rulers along x and y are on the printed sheet, mm: --describe then "
            "writes the target's real lengths.",
        ),
        click.option(
            "--describe",
            metavar="FILE",
            type=click.Path(dir_okay=False),
            help="Write the target's description there, as JSON.",
        ),
        click.option(
            "-o",
            "--output",
            "outputs",
            metavar="FILE",
            type=click.Path(dir_okay=False),
            multiple=True,
            help="Where the sheet goes; .svg or .pdf. May be given twice.",
        ),
        click.option(
            "--page",
            metavar="PAGE",
            default="A4",
            show_default=True,
            help="A0 to A5, Letter, Legal or Tabloid, upright or lying as it fits; or WIDTHxHEIGHT "
            "in mm.",
        ),
    ):
        function = option(function)
    return function


@sheet.command()
@_count("--columns", "Inner corners along x.")
@_count("--rows", "Inner corners along y.")
@_length("--square", about="Side of a square.", required=True)
@click.option(
    "--origin-mark/--no-origin-mark",
    default=True,
    show_default=True,
    help="A black dot outside of the corner at the origin.",
)
@_outputs
def checkerboard(columns: int, rows: int, square: float, origin_mark: bool, **given: Any) -> None:
    """A checkerboard."""
    _make(
        {
            "kind": "checkerboard",
            "columns": columns,
            "rows": rows,
            "square": _metres(square),
            "origin_mark": origin_mark,
        },
        **given,
    )


@sheet.command()
@_count("--columns", "Squares along x.")
@_count("--rows", "Squares along y.")
@_length("--square", about="Side of a square.", required=True)
@_length("--marker", about="Side of a marker.  [default: 0.75 of a square]")
@click.option(
    "--dictionary",
    metavar="NAME",
    default="DICT_5X5_250",
    show_default=True,
    help="OpenCV's name of the markers' dictionary.",
)
@click.option(
    "--legacy-pattern", is_flag=True, help="As OpenCV before 4.6 has it: differs with even rows."
)
@_outputs
def charuco(
    columns: int,
    rows: int,
    square: float,
    marker: float | None,
    dictionary: str,
    legacy_pattern: bool,
    **given: Any,
) -> None:
    """A checkerboard with a marker in each white square: some of it may be hidden."""
    _make(
        {
            "kind": "charuco",
            "columns": columns,
            "rows": rows,
            "square": _metres(square),
            "marker": _metres(0.75 * square if marker is None else marker),
            "dictionary": dictionary,
            "legacy_pattern": legacy_pattern,
        },
        **given,
    )


@sheet.command()
@_count("--columns", "Dots of a row.")
@_count("--rows", "Rows.")
@_length("--spacing", about="Between the middles of two neighbours of a row.", required=True)
@_length("--diameter", about="Of a dot.  [default: half of the spacing, asymmetric: 0.4 of it]")
@click.option("--asymmetric", is_flag=True, help="Shift every other row, rows half as far apart.")
@_length("--origin-diameter", about="Of the dot at the origin, where it is larger than the others.")
@_outputs
def circles(
    columns: int,
    rows: int,
    spacing: float,
    diameter: float | None,
    asymmetric: bool,
    origin_diameter: float | None,
    **given: Any,
) -> None:
    """Dots in rows and columns."""
    dot = (0.4 if asymmetric else 0.5) * spacing if diameter is None else diameter
    _make(
        {
            "kind": "circles",
            "columns": columns,
            "rows": rows,
            "spacing": _metres(spacing),
            "diameter": _metres(dot),
            "asymmetric": asymmetric,
            "origin_diameter": None if origin_diameter is None else _metres(origin_diameter),
        },
        **given,
    )


@sheet.command()
@_length("--diameter", about="Of the origin mark.", default=20.0, show_default=True)
@_outputs
def rays(diameter: float, **given: Any) -> None:
    """Rays A and B and an origin mark, which a smart camera can localize."""
    _make({"kind": "rays", "diameter": _metres(diameter)}, **given)


def _make(
    described: dict[str, Any],
    *,
    page: str,
    outputs: tuple[str, ...],
    describe: str | None,
    measured: tuple[float, float] | None,
    **shared: Any,
) -> None:
    """Lay out a sheet of what is described and write what is asked for."""
    if not outputs and describe is None:
        raise click.UsageError("nothing to write: give -o FILE.svg, -o FILE.pdf or --describe FILE")
    if measured is not None and describe is None:
        raise click.UsageError("--measured-ruler needs --describe")
    for path in outputs:
        if _suffix(path) not in {".svg", ".pdf"}:
            raise click.UsageError(f"-o {path}: expected a name that ends with .svg or .pdf")
    options = Options(**shared)

    async def main() -> None:
        from smartcam.calibration.printing.sheets import make_sheet, on_paper, scaled

        made = make_sheet(on_paper(described), page=page)
        real = made.target if measured is None else scaled(made.target, measured)
        data = replace(made, target=real).data
        for path in outputs:
            _write(path, made.pdf() if _suffix(path) == ".pdf" else made.svg().encode())
        if describe is not None:
            _write(describe, (json.dumps(data) + "\n").encode())
        written = [*outputs, *([] if describe is None else [describe])]
        value = {
            "id": made.id,
            "files": written,
            "page_mm": [made.width, made.height],
            "origin_mm": list(made.origin),
            "target": data,
        }
        text = f"{made.title}\n  {made.width:g} x {made.height:g} mm: {', '.join(written)}"
        options.show(value, text)

    run(main(), program="smartcam", debug=options.debug)


def _metres(millimetres: float) -> float:
    return round(millimetres / 1e3, DIGITS)


def _suffix(path: str) -> str:
    return Path(path).suffix.lower()


def _write(path: str, data: bytes) -> None:
    try:
        Path(path).write_bytes(data)
    except OSError as exc:
        raise ConfigurationError(f"{path}: {exc.strerror}") from exc
