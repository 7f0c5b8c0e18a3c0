"""``smartcam inspect``: try an application of a software camera on pictures in files."""

from __future__ import annotations

import asyncio
import html
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from smartcam._cli.options import OUTPUT, Options, from_hex, naming, option, runs
from smartcam._cli.texts import value_text
from smartcam.exceptions import ConfigurationError, FrameFormatError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from smartcam.inspection import Inspection, Program
    from smartcam.layout._inside import ShownUnits

SUFFIXES: Final = frozenset(
    {".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".pnm", ".ppm", ".tif", ".tiff", ".webp"}
)
"""Suffixes of the files in a folder that count as pictures, in lower case."""

PAGE: Final = "index.html"


@click.command(
    help="Try an application of a software camera on pictures, and draw its findings. CELL is a "
    "cell file, or a fleet file with software cameras. APPLICATION is a number or a name, and "
    "PICTURES are files or folders. Prints the results; --output also draws the tools' "
    "findings."
)
@click.argument("cell")
@click.argument("camera")
@click.argument("which", metavar="APPLICATION")
@click.argument("pictures", nargs=-1, required=True)
@option("--output", help="Draw the findings into this folder: PNG files, and a page of them all.")
@click.option("--input", "given", metavar="HEX", default="", help="Input data of each trigger.")
@option("--units")
@runs(*OUTPUT)
async def inspect(
    cell: str,
    camera: str,
    which: str,
    pictures: Sequence[str],
    output: str | None,
    given: str,
    options: Options,
) -> None:
    """Inspect the pictures one by one, print the results, and draw the findings."""
    from smartcam._suggestions import did_you_mean
    from smartcam.inspection import load_cell
    from smartcam.layout._inside import ShownUnits

    units = ShownUnits([unit for unit in (options.units or "").split(",") if unit])
    data = from_hex(given, "--input")
    cameras = load_cell(cell)
    if camera not in cameras:
        raise ConfigurationError(
            f"{cell}: no software camera {camera!r:.80}; there are {', '.join(cameras)}"
            f"{did_you_mean(camera, cameras)}"
        )
    program = cameras[camera].program(which)
    files = [file for picture in pictures for file in picture_files(Path(picture))]
    folder = None if output is None else Path(output)
    if folder is not None:
        with naming(f"--output {output}"):
            folder.mkdir(parents=True, exist_ok=True)
    failed: FrameFormatError | None = None
    rows: list[str] = []
    for number, file in enumerate(files, 1):
        try:
            inspection = await asyncio.to_thread(_inspect, program, file, data)
        except FrameFormatError as exc:
            failed = exc
            options.show({"file": str(file), "error": str(exc)}, f"{file}: {exc}")
            continue
        drawn = None if folder is None else folder / f"{number:04}-{file.stem}.png"
        if drawn is not None:
            with naming(f"--output {output}"):
                await asyncio.to_thread(_write, drawn, inspection)
            rows.append(_row(file, inspection, drawn))
        options.show(_fields(file, inspection, drawn), _text(file, inspection, units))
    if folder is not None:
        title = f"{camera}: {program.name}"
        with naming(f"--output {output}"):
            (folder / PAGE).write_text(_page(title, rows), encoding="utf-8")
    if failed is not None:
        raise failed


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


def _write(path: Path, inspection: Inspection) -> None:
    from smartcam._extras import load

    coded = load("cv2", "inspection needs").imencode(".png", inspection.drawn()[:, :, ::-1])[1]
    path.write_bytes(coded.tobytes())


def _fields(file: Path, inspection: Inspection, drawn: Path | None) -> dict[str, Any]:
    return {
        "file": str(file),
        "ok": inspection.ok,
        "reason": inspection.reason,
        "value": inspection.value,
        "milliseconds": {name: 1e3 * seconds for name, seconds in inspection.seconds.items()},
        **({} if drawn is None else {"drawn": str(drawn)}),
    }


def _text(file: Path, inspection: Inspection, units: ShownUnits) -> str:
    verdict = "ok" if inspection.ok else "not ok"
    took = 1e3 * sum(inspection.seconds.values())
    text = value_text(inspection.value, units, inspection.layout)
    return f"{file}: {verdict}, {took:.1f} ms\n{text}"


def _row(file: Path, inspection: Inspection, drawn: Path) -> str:
    kind = "ok" if inspection.ok else "not-ok"
    text = html.escape(f"{file.name}: {inspection.reason or 'ok'}")
    link = html.escape(drawn.name, quote=True)
    return f'<figure class="{kind}"><img src="{link}" alt="{text}"><figcaption>{text}</figcaption>'


def _page(title: str, rows: Sequence[str]) -> str:
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        f"<title>{html.escape(title)}</title><style>"
        "body{font:16px system-ui;margin:1em;display:flex;flex-wrap:wrap;gap:1em}"
        "h1{flex-basis:100%}figure{margin:0;max-width:30em}img{max-width:100%}"
        ".ok{border-top:4px solid #2ecc40}.not-ok{border-top:4px solid #ff4136}"
        f"</style><h1>{html.escape(title)}</h1>"
        + "".join(f"{row}</figure>" for row in rows)
        + "</html>\n"
    )
