"""``smartcam sheet``: a sheet with a target, to print."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from smartcam._cli.options import OUTPUT_OPTIONS, Options, async_command, label_file_errors
from smartcam._cli.usage import ListedGroup

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

F = TypeVar("F", bound="Callable[..., Any]")

LENGTH_DECIMALS = 9
"""Number of decimals to which a length in metres is rounded."""


@click.group(cls=ListedGroup)
def sheet() -> None:
    """Make a sheet to print: a target in true size, rays A and B from its origin, rulers.

    Lengths are in millimetres. Print at 100 %, then measure both rulers: printers change sizes.
    """


def _to_metres(_context: object, _option: object, millimetres: float | None) -> float | None:
    return None if millimetres is None else round(millimetres / 1e3, LENGTH_DECIMALS)


def _length_option(name: str, about: str, **settings: Any) -> Callable[[F], F]:
    kind = click.FloatRange(min=0, min_open=True, max=10_000)
    return click.option(name, type=kind, metavar="MM", callback=_to_metres, help=about, **settings)


def _count_option(name: str, about: str, min_count: int = 3) -> Callable[[F], F]:
    return click.option(name, type=click.IntRange(min_count, 1000), required=True, help=about)


def _sheet_command(
    function: Callable[..., Coroutine[Any, Any, None]],
) -> Callable[..., None]:
    """Decorate a coroutine function: it becomes a command with the options of all sheets."""
    command = async_command(*OUTPUT_OPTIONS)(function)
    for option in (
        click.option(
            "--measured-ruler",
            "measured_rulers",
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
@_count_option("--columns", "Inner corners along x.")
@_count_option("--rows", "Inner corners along y.")
@_length_option("--square", "Side of a square.", required=True)
@click.option(
    "--origin-mark/--no-origin-mark",
    default=True,
    show_default=True,
    help="A black dot outside of the corner at the origin.",
)
@_sheet_command
async def checkerboard(**arguments: Any) -> None:
    """A checkerboard."""
    await _write_sheet("checkerboard", **arguments)


@sheet.command()
@_count_option("--columns", "Squares along x.")
@_count_option("--rows", "Squares along y.")
@_length_option("--square", "Side of a square.", required=True)
@_length_option("--marker", "Side of a marker.  [default: 0.75 of a square]")
@click.option(
    "--dictionary",
    metavar="NAME",
    default="DICT_5X5_250",
    show_default=True,
    help="OpenCV's name of the markers' dictionary.",
)
@click.option(
    "--legacy-pattern", is_flag=True, help="As in OpenCV before 4.6: differs if --rows is even."
)
@_sheet_command
async def charuco(square: float, marker: float | None, **arguments: Any) -> None:
    """A checkerboard with a marker in each white square: a part may be hidden from the camera."""
    side = round(0.75 * square, LENGTH_DECIMALS) if marker is None else marker
    await _write_sheet("charuco", square=square, marker=side, **arguments)


@sheet.command("marker_grid")
@_count_option("--columns", "Markers along x.", min_count=1)
@_count_option("--rows", "Markers along y.", min_count=1)
@_length_option("--marker", "Side of a marker, with its black border.", required=True)
@_length_option("--gap", "Distance between two markers.", required=True)
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
@_sheet_command
async def marker_grid(dictionary: str, kalibr: bool, **arguments: Any) -> None:
    """Markers in rows and columns: some of them may be hidden from the camera."""
    if kalibr:
        arguments |= {"dictionary": "DICT_APRILTAG_36h11", "border": 2, "kalibr": True}
    else:
        arguments["dictionary"] = dictionary
    await _write_sheet("marker_grid", **arguments)


@sheet.command()
@_count_option("--columns", "Dots of a row.")
@_count_option("--rows", "Rows.")
@_length_option("--spacing", "Distance of the centres of two neighbours in a row.", required=True)
@_length_option(
    "--diameter", "Diameter of a dot.  [default: half of the spacing, asymmetric: 0.4 of it]"
)
@click.option("--asymmetric", is_flag=True, help="Shift every other row, rows half as far apart.")
@_length_option(
    "--origin-diameter", "Diameter of the dot at the origin, if it is larger than the others."
)
@_sheet_command
async def circles(
    spacing: float, diameter: float | None, asymmetric: bool, **arguments: Any
) -> None:
    """Dots in rows and columns."""
    ratio = 0.4 if asymmetric else 0.5
    dot = round(ratio * spacing, LENGTH_DECIMALS) if diameter is None else diameter
    await _write_sheet("circles", spacing=spacing, diameter=dot, asymmetric=asymmetric, **arguments)


@sheet.command()
@_length_option("--diameter", "Diameter of the origin mark.", default=20.0, show_default=True)
@_sheet_command
async def rays(**arguments: Any) -> None:
    """Rays A and B and an origin mark, which a smart camera can localize."""
    await _write_sheet("rays", **arguments)


async def _write_sheet(
    kind: str,
    *,
    page: str,
    outputs: tuple[str, ...],
    describe: str | None,
    measured_rulers: tuple[float, float] | None,
    options: Options,
    **target_settings: Any,
) -> None:
    """Make a sheet with its target, and write the files that the options name."""
    if not outputs and describe is None:
        raise click.UsageError("nothing to write: give -o FILE.svg, -o FILE.pdf or --describe FILE")
    if measured_rulers is not None and describe is None:
        raise click.UsageError("--measured-ruler needs --describe")
    for path in outputs:
        if _lower_suffix(path) not in {".svg", ".pdf"}:
            raise click.UsageError(f"-o {path}: expected a name that ends with .svg or .pdf")
    from smartcam.calibration import make_sheet, scale_target
    from smartcam.calibration._inside import target_from_description

    new_sheet = make_sheet(target_from_description({"kind": kind, **target_settings}), page=page)
    target = new_sheet.target
    if measured_rulers is not None:
        target = scale_target(target, measured_rulers)
    data = replace(new_sheet, target=target).data
    for path in outputs:
        _write(path, new_sheet.pdf() if _lower_suffix(path) == ".pdf" else new_sheet.svg().encode())
    if describe is not None:
        _write(describe, (json.dumps(data) + "\n").encode())
    files = [*outputs, *([] if describe is None else [describe])]
    value = {
        "id": new_sheet.id,
        "files": files,
        "page_mm": [new_sheet.width, new_sheet.height],
        "origin_mm": list(new_sheet.origin),
        "target": data,
    }
    size = f"{new_sheet.width:g} x {new_sheet.height:g} mm"
    text = f"{new_sheet.title}\n  {size}: {', '.join(files)}"
    options.show(value, text)


def _lower_suffix(path: str) -> str:
    return Path(path).suffix.lower()


def _write(path: str, data: bytes) -> None:
    with label_file_errors(path):
        Path(path).write_bytes(data)
