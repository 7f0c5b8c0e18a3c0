"""``smartcam frames record``: record a camera's pictures in a file, or in a series of files."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from smartcam._cli.frame_sources import TIMEOUT, make_source
from smartcam._cli.options import OUTPUT_OPTIONS, Options, async_command, option
from smartcam._cli.running import run_until_first

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.exceptions import RecordingError
    from smartcam.frames import FrameSource
    from smartcam.recording import Recorder, RotatingRecorder

BYTES = {"kB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}
SECONDS = {"s": 1, "min": 60, "h": 3600, "d": 86_400}


if TYPE_CHECKING:
    _AmountType = click.ParamType[float]
else:
    _AmountType = click.ParamType


class _Amount(_AmountType):
    """A number with a unit, such as ``100 MB``."""

    def __init__(self, name: str, units: Mapping[str, int]) -> None:
        self.name = name
        self._units = units

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([A-Za-z]+)\s*", str(value))
        if match is None or match[2] not in self._units:
            self.fail(
                f"{value!r}: expected a number and one of {', '.join(self._units)}", param, ctx
            )
        return float(match[1]) * self._units[match[2]]


@click.command(
    name="record",
    help="Record a source until Ctrl-C, its end, --count or --seconds. FILE.mcap holds every frame "
    "as the source gave it, with its times, number and losses. Foxglove shows it; 'smartcam "
    "frames' and, in Python, frames.open() play it. FILE.mkv is a lossless video (JPEGs as they "
    "are) for players, with the captures' times in milliseconds; it needs the extra "
    '"video". FOLDER gets consecutive files; the oldest are deleted when all exceed --keep. If the '
    "disk is too slow, pictures are left out and counted; the camera never waits. Needs the extra "
    '"record".',
)
@click.argument("url")
@click.option(
    "-o",
    "--output",
    metavar="FILE.mcap|FILE.mkv|FOLDER",
    required=True,
    help="File or folder to write.",
)
@option("--force")
@option("--name", help="The camera's name in the file; default made of the URL.")
@option("--count", help="End after this many pictures.")
@option("--seconds", help="End this many seconds after the first picture.")
@click.option(
    "--size",
    type=_Amount("SIZE", BYTES),
    help="Size of a file in a folder, before the next one begins.  [default: 1 GB]",
)
@click.option(
    "--age",
    type=_Amount("AGE", SECONDS),
    help="Age of a file in a folder at which the next one begins.  [default: 1 h]",
)
@click.option(
    "--keep",
    type=_Amount("SIZE", BYTES),
    help="Size of all files of a folder, above which the oldest are deleted.  [default: 10 GB]",
)
@option("--timeout", help=TIMEOUT)
@async_command(*OUTPUT_OPTIONS, interrupt_code=0)
async def record(
    url: str,
    output: str,
    force: bool,
    size: float | None,
    age: float | None,
    keep: float | None,
    options: Options,
) -> None:
    """Record a source of frames."""
    from smartcam.recording import Recorder
    from smartcam.recording._inside import name_in_recording

    bounds = {"size": size, "age": age, "keep": keep}
    given_bounds = {name: bound for name, bound in bounds.items() if bound is not None}
    recorder = _make_recorder(output, given_bounds, force=force)
    async with make_source(url, options) as source:
        recorder.open()
        try:
            if isinstance(recorder, Recorder):
                recorder.describe(
                    options.name or name_in_recording(source.name), frames=source.name
                )
            options.show(
                {"url": source.name, "file": str(recorder.path)},
                f"recording {source.name} to {recorder.path}, Ctrl-C to end",
            )
            await _record(source, recorder, options.name or name_in_recording(source.name), options)
        finally:
            await _close_and_report(recorder, source.statistics().lost, options)


def _make_recorder(
    output: str, bounds: dict[str, float], *, force: bool
) -> Recorder | RotatingRecorder:
    """Return the recorder for a file (a recording or a video), or for a folder."""
    from smartcam.recording import Recorder, RotatingRecorder

    suffix = Path(output).suffix.lower()
    if suffix in (".mcap", ".mkv") and not Path(output).is_dir():
        if bounds:
            raise click.UsageError(
                f"--{next(iter(bounds))} is for a folder of consecutive files, such as "
                f"-o {Path(output).with_suffix('')}"
            )
        return Recorder(output, overwrite=force)
    if suffix:
        raise click.BadParameter(
            f"{output}: expected FILE.mcap, FILE.mkv, or a folder, whose name has no suffix",
            param_hint="'-o' / '--output'",
        )
    return RotatingRecorder(output, on_trouble=_report_trouble, **bounds)


def _report_trouble(trouble: RecordingError | None) -> None:
    text = "recording has resumed" if trouble is None else f"{trouble}; pictures are lost"
    click.echo(f"smartcam: note: {text}", err=True)


async def _record(
    source: FrameSource, recorder: Recorder | RotatingRecorder, name: str, options: Options
) -> None:
    """Record until the source ends, or the count or time of the options is reached."""
    started = asyncio.Event()

    async def record_pictures() -> None:
        await recorder.record(source, camera=name, count=options.count, on_start=started.set)

    async def stop_after(seconds: float) -> None:
        await started.wait()
        await asyncio.sleep(seconds)

    jobs = [record_pictures()]
    if options.seconds is not None:
        jobs.append(stop_after(options.seconds))
    await run_until_first(jobs, None)


async def _close_and_report(
    recorder: Recorder | RotatingRecorder, lost: int, options: Options
) -> None:
    """Close the recording and report its contents; remove a file without a picture.

    ``lost``: pictures that the source lost; the recorder itself counts those that it left out.
    """
    from smartcam.recording import RotatingRecorder

    await asyncio.to_thread(recorder.close)
    if isinstance(recorder, RotatingRecorder):
        for name, each in recorder.counts.items():
            value = {"camera": name, "pictures": each.written, "left_out": each.lost}
            _show_counts(
                f"{recorder.path}: {name}", {"file": str(recorder.path), **value}, lost, options
            )
        return
    counts = recorder.counts
    if not counts.pictures:
        recorder.path.unlink(missing_ok=True)
        return
    for path in recorder.files:
        size = path.stat().st_size
        value = {"pictures": counts.pictures, "left_out": counts.left_out, "bytes": size}
        _show_counts(str(path), {"file": str(path), **value}, lost, options)


def _show_counts(label: str, value: dict[str, Any], lost: int, options: Options) -> None:
    value["lost"] = lost
    counts = f"pictures {value['pictures']}, left out {value['left_out']}, lost {lost}"
    size = f"; {value['bytes']} bytes" if "bytes" in value else ""
    options.show(value, f"{label}: {counts}{size}")
