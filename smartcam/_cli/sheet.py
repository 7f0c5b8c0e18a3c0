"""``smartcam sheet``: a sheet with a target, to print."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from smartcam._cli.options import OUTPUT, Options, naming, runs
from smartcam._cli.usage import ListedGroup

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

F = TypeVar("F", bound="Callable[..., Any]")

LENGTH_DECIMALS = 9
"""Decimals of a length in metres, which is rounded to nanometres."""


@click.group(cls=ListedGroup)
def sheet() -> None:
    """Make a sheet to print: a target to scale, rays A and B from its origin, rulers.

    Lengths are in millimetres. Print at 100 %, then measure both rulers: printers scale.
    """


def _metres(_context: object, _option: object, millimetres: float | None) -> float | None:
    return None if millimetres is None else round(millimetres / 1e3, LENGTH_DECIMALS)


def _length(name: str, about: str, **more: Any) -> Callable[[F], F]:
    kind = click.FloatRange(min=0, min_open=True, max=10_000)
    return click.option(name, type=kind, metavar="MM", callback=_metres, help=about, **more)


def _count(name: str, about: str, least: int = 3) -> Callable[[F], F]:
    return click.option(name, type=click.IntRange(least, 1000), required=True, help=about)


def _makes(
    function: Callable[..., Coroutine[Any, Any, None]],
) -> Callable[..., None]:
    """Turn a coroutine function into a sheet's command, with the options of all sheets."""
    command = runs(*OUTPUT)(function)
    for option in (
        click.option(
            "--measured-ruler",
            "measured",
            nargs=2,
            type=float,
            metavar="X Y",
            help="Measured lengths of the printed rulers along x and y, mm: --describe then "
            "writes the target's real lengths.",
        ),
        click.option(
            "--describe",
            metavar="FILE",
            type=click.Path(dir_okay=False),
            help="File for the target's description, as JSON.",
        ),
        click.option(
            "-o",
            "--output",
            "outputs",
            metavar="FILE",
            type=click.Path(dir_okay=False),
            multiple=True,
            help="File for the sheet; .svg or .pdf. May be given twice.",
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
        command = option(command)
    return command


@sheet.command()
@_count("--columns", "Inner corners along x.")
@_count("--rows", "Inner corners along y.")
@_length("--square", "Side of a square.", required=True)
@click.option(
    "--origin-mark/--no-origin-mark",
    default=True,
    show_default=True,
    help="A black dot outside of the corner at the origin.",
)
@_makes
async def checkerboard(**given: Any) -> None:
    """A checkerboard."""
    await _make("checkerboard", **given)


@sheet.command()
@_count("--columns", "Squares along x.")
@_count("--rows", "Squares along y.")
@_length("--square", "Side of a square.", required=True)
@_length("--marker", "Side of a marker.  [default: 0.75 of a square]")
@click.option(
    "--dictionary",
    metavar="NAME",
    default="DICT_5X5_250",
    show_default=True,
    help="OpenCV's name of the markers' dictionary.",
)
@click.option(
    "--legacy-pattern", is_flag=True, help="As in OpenCV before 4.6: differs with even rows."
)
@_makes
async def charuco(square: float, marker: float | None, **given: Any) -> None:
    """A checkerboard with a marker in each white square: some of it may be hidden."""
    side = round(0.75 * square, LENGTH_DECIMALS) if marker is None else marker
    await _make("charuco", square=square, marker=side, **given)


@sheet.command("marker_grid")
@_count("--columns", "Markers along x.", least=1)
@_count("--rows", "Markers along y.", least=1)
@_length("--marker", "Side of a marker, with its black border.", required=True)
@_length("--gap", "Distance between two markers.", required=True)
@click.option(
    "--dictionary",
    metavar="NAME",
    default="DICT_4X4_50",
    show_default=True,
    help="OpenCV's name of the markers' dictionary.",
)
@click.option(
    "--kalibr",
    is_flag=True,
    help="An AprilGrid of Kalibr: tags of 36h11 with a border of two modules, numbered from "
    "the lower left, with squares between their corners.",
)
@_makes
async def marker_grid(dictionary: str, kalibr: bool, **given: Any) -> None:
    """Markers in rows and columns: some of them may be hidden."""
    if kalibr:
        given |= {"dictionary": "DICT_APRILTAG_36h11", "border": 2, "kalibr": True}
    else:
        given["dictionary"] = dictionary
    await _make("marker_grid", **given)


@sheet.command()
@_count("--columns", "Dots of a row.")
@_count("--rows", "Rows.")
@_length("--spacing", "Distance of the centres of two neighbours in a row.", required=True)
@_length("--diameter", "Diameter of a dot.  [default: half of the spacing, asymmetric: 0.4 of it]")
@click.option("--asymmetric", is_flag=True, help="Shift every other row, rows half as far apart.")
@_length("--origin-diameter", "Diameter of the dot at the origin, if it is larger than the others.")
@_makes
async def circles(spacing: float, diameter: float | None, asymmetric: bool, **given: Any) -> None:
    """Dots in rows and columns."""
    part = 0.4 if asymmetric else 0.5
    dot = round(part * spacing, LENGTH_DECIMALS) if diameter is None else diameter
    await _make("circles", spacing=spacing, diameter=dot, asymmetric=asymmetric, **given)


@sheet.command()
@_length("--diameter", "Diameter of the origin mark.", default=20.0, show_default=True)
@_makes
async def rays(**given: Any) -> None:
    """Rays A and B and an origin mark, which a smart camera can localize."""
    await _make("rays", **given)


async def _make(
    kind: str,
    *,
    page: str,
    outputs: tuple[str, ...],
    describe: str | None,
    measured: tuple[float, float] | None,
    options: Options,
    **described: Any,
) -> None:
    """Lay out a sheet with its target and write the files of the options."""
    if not outputs and describe is None:
        raise click.UsageError("nothing to write: give -o FILE.svg, -o FILE.pdf or --describe FILE")
    if measured is not None and describe is None:
        raise click.UsageError("--measured-ruler needs --describe")
    for path in outputs:
        if _suffix(path) not in {".svg", ".pdf"}:
            raise click.UsageError(f"-o {path}: expected a name that ends with .svg or .pdf")
    from smartcam.calibration import make_sheet, scaled
    from smartcam.calibration._inside import on_paper

    made = make_sheet(on_paper({"kind": kind, **described}), page=page)
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


def _suffix(path: str) -> str:
    return Path(path).suffix.lower()


def _write(path: str, data: bytes) -> None:
    with naming(path):
        Path(path).write_bytes(data)
