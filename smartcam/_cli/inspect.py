"""``smartcam inspect``: try an application of a software camera on pictures in files."""

from __future__ import annotations

import asyncio
import html
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from smartcam._cli.options import (
    OUTPUT_OPTIONS,
    Options,
    async_command,
    from_hex,
    label_file_errors,
    option,
)
from smartcam._cli.texts import value_text
from smartcam.exceptions import ConfigurationError, FrameFormatError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from smartcam.inspection import Inspection, Program
    from smartcam.layout._inside import ShownUnits

SUFFIXES: Final = frozenset(
    {".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".pnm", ".ppm", ".tif", ".tiff", ".webp"}
)
"""Suffixes, in lower case, of the files in a folder that are taken for pictures."""

PAGE: Final = "index.html"


@click.command(
    help="Try an application of a software camera on pictures, and draw its findings. CELL is a "
    "cell file, or a fleet file with software cameras. APPLICATION is a number or a name, and "
    "PICTURES are files or folders. Prints the results; --output also draws the tools' "
    "findings."
)
@click.argument("cell")
@click.argument("camera")
@click.argument("application_name", metavar="APPLICATION")
@click.argument("pictures", nargs=-1, required=True)
@option("--output", help="Draw the findings into this folder: PNG files, and a page of them all.")
@click.option("--input", "input_hex", metavar="HEX", default="", help="Input data of each trigger.")
@option("--units")
@async_command(*OUTPUT_OPTIONS)
async def inspect(
    cell: str,
    camera: str,
    application_name: str,
    pictures: Sequence[str],
    output: str | None,
    input_hex: str,
    options: Options,
) -> None:
    """Inspect the pictures one by one, print the results, and draw the findings."""
    from smartcam._suggestions import did_you_mean
    from smartcam.inspection import load_cell
    from smartcam.layout._inside import ShownUnits

    units = ShownUnits([unit for unit in (options.units or "").split(",") if unit])
    data = from_hex(input_hex, "--input")
    cameras = load_cell(cell)
    if camera not in cameras:
        raise ConfigurationError(
            f"{cell}: no software camera {camera!r:.80}; there are {', '.join(cameras)}"
            f"{did_you_mean(camera, cameras)}"
        )
    program = cameras[camera].program(application_name)
    files = [file for picture in pictures for file in picture_files(Path(picture))]
    folder = None if output is None else Path(output)
    if folder is not None:
        with label_file_errors(f"--output {output}"):
            folder.mkdir(parents=True, exist_ok=True)
    error: FrameFormatError | None = None
    figures: list[str] = []
    for number, file in enumerate(files, 1):
        try:
            inspection = await asyncio.to_thread(_inspect, program, file, data)
        except FrameFormatError as exc:
            error = exc
            options.show({"file": str(file), "error": str(exc)}, f"{file}: {exc}")
            continue
        picture_path = None if folder is None else folder / f"{number:04}-{file.stem}.png"
        if picture_path is not None:
            with label_file_errors(f"--output {output}"):
                await asyncio.to_thread(_write_picture, picture_path, inspection)
            figures.append(_figure(file, inspection, picture_path))
        options.show(
            _inspection_data(file, inspection, picture_path),
            _inspection_text(file, inspection, units),
        )
    if folder is not None:
        title = f"{camera}: {program.name}"
        with label_file_errors(f"--output {output}"):
            (folder / PAGE).write_text(_page(title, figures), encoding="utf-8")
    if error is not None:
        raise error


def picture_files(path: Path) -> Iterator[Path]:
    """Yield a file, or the pictures of a folder in the order of their names."""
    from smartcam._natural import natural

    if not path.is_dir():
        if not path.exists():
            raise ConfigurationError(f"{path}: there is no such file or folder")
        yield path
        return
    files = [file for file in path.iterdir() if file.suffix.lower() in SUFFIXES]
    if not files:
        raise ConfigurationError(f"{path}: there is no picture in this folder")
    yield from sorted(files, key=lambda file: natural(file.name))


def _inspect(program: Program, file: Path, data: bytes) -> Inspection:
    from smartcam.inspection import Picture

    return program.inspect(Picture.read(file), input=data)


def _write_picture(path: Path, inspection: Inspection) -> None:
    from smartcam._extras import load

    coded = load("cv2", "inspection needs").imencode(".png", inspection.drawn()[:, :, ::-1])[1]
    path.write_bytes(coded.tobytes())


def _inspection_data(
    file: Path, inspection: Inspection, picture_path: Path | None
) -> dict[str, Any]:
    return {
        "file": str(file),
        "ok": inspection.ok,
        "reason": inspection.reason,
        "value": inspection.value,
        "milliseconds": {name: 1e3 * seconds for name, seconds in inspection.seconds.items()},
        **({} if picture_path is None else {"drawn": str(picture_path)}),
    }


def _inspection_text(file: Path, inspection: Inspection, units: ShownUnits) -> str:
    verdict = "ok" if inspection.ok else "not ok"
    took = 1e3 * sum(inspection.seconds.values())
    text = value_text(inspection.value, units, inspection.layout)
    return f"{file}: {verdict}, {took:.1f} ms\n{text}"


def _figure(file: Path, inspection: Inspection, picture_path: Path) -> str:
    style = "ok" if inspection.ok else "not-ok"
    text = html.escape(f"{file.name}: {inspection.reason or 'ok'}")
    link = html.escape(picture_path.name, quote=True)
    return f'<figure class="{style}"><img src="{link}" alt="{text}"><figcaption>{text}</figcaption>'


def _page(title: str, figures: Sequence[str]) -> str:
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        f"<title>{html.escape(title)}</title><style>"
        "body{font:16px system-ui;margin:1em;display:flex;flex-wrap:wrap;gap:1em}"
        "h1{flex-basis:100%}figure{margin:0;max-width:30em}img{max-width:100%}"
        ".ok{border-top:4px solid #2ecc40}.not-ok{border-top:4px solid #ff4136}"
        f"</style><h1>{html.escape(title)}</h1>"
        + "".join(f"{figure}</figure>" for figure in figures)
        + "</html>\n"
    )
