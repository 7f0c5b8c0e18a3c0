"""``smartcam frames``: pictures of any camera, listed, written, shown and measured."""

from __future__ import annotations

import asyncio
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from smartcam._cli.frame_colours import colours
from smartcam._cli.frame_features import features_command, force_address_command
from smartcam._cli.frame_files import SUFFIXES, Encoding, numbered_names
from smartcam._cli.frame_measure import measure, measurement_text
from smartcam._cli.frame_sources import TIMEOUT, make_source
from smartcam._cli.frames_record import record
from smartcam._cli.frames_serve import serve, show
from smartcam._cli.options import OUTPUT_OPTIONS, Options, async_command, option
from smartcam._cli.usage import ListedGroup
from smartcam.exceptions import (
    ConfigurationError,
    FrameSourceError,
    SmartCamError,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.frames import FoundSource, Frame, FrameSource

MAX_FILES = 100_000
"""Largest number of files that one command writes."""


@click.group(
    cls=ListedGroup,
    help="Pictures of any camera. URL is v4l2:///dev/video0, gige://HOST, rtsp://HOST/PATH, "
    "http://HOST/PATH, insight://HOST, synthetic:// (which needs no camera), or the path of a "
    "video; ?format=YUYV&size=640x480&fps=30 and the like set the stream. A device streams "
    "while there is a reader.",
)
def frames() -> None:
    """Register the commands of frames."""


frames.add_command(record)
frames.add_command(serve)
frames.add_command(show)
frames.add_command(features_command)
frames.add_command(force_address_command)


# ---------------------------------------------------------------------- list


@frames.command(
    name="list",
    help="List the devices that are found on this machine and its network: the URL of each, "
    "its formats and, if it cannot be opened, the reason.",
)
@click.option("--scheme", metavar="SCHEME", help="Only search for this scheme, such as v4l2.")
@option("--timeout", help="Longest time of the search.  [default: 5]")
@async_command(*OUTPUT_OPTIONS)
async def list_(scheme: str | None, options: Options) -> None:
    from smartcam.frames._inside import FRAME_TIMEOUT
    from smartcam.registry import FRAMES

    all_schemes = [info.name for info in FRAMES.available()]
    schemes = all_schemes if scheme is None else [scheme]
    seconds = options.step_timeout(FRAME_TIMEOUT)
    searches = await asyncio.gather(*(_search(name, seconds) for name in schemes))
    shown_urls: set[str] = set()
    searched = [name for name, search in zip(schemes, searches, strict=True) if search is not None]
    for name, search in zip(schemes, searches, strict=True):
        if search is None:
            continue
        if isinstance(search, Exception):
            if isinstance(search, ConfigurationError) and scheme is not None:
                raise search
            _show_search_error(name, search, options)
            continue
        for source in search:
            if source.url not in shown_urls:
                shown_urls.add(source.url)
                options.show(_source_data(source), _source_text)
    if not shown_urls and not options.as_json:
        click.echo(
            f"nothing found; looked for: {', '.join(searched)}"
            if searched
            else f"{scheme}:// has no search: open its sources by their URLs"
        )


async def _search(scheme: str, seconds: float) -> list[FoundSource] | Exception | None:
    """Return the sources that a scheme's driver finds, None if the driver has no search.

    The error of a failed search is returned and not raised, so that the other schemes are listed.
    """
    from smartcam.frames import discover
    from smartcam.registry import FRAMES

    try:
        if scheme in FRAMES and _has_no_search(FRAMES.load(scheme)):
            return None
        async with asyncio.timeout(seconds):
            return await discover(scheme)
    except TimeoutError:
        return FrameSourceError(f"the search took longer than {seconds:g} s")
    except Exception as exc:  # noqa: BLE001 - a plug-in may raise anything
        return exc


def _has_no_search(driver: Any) -> bool:
    from smartcam.frames import FrameDriver

    return next(kind for kind in driver.__mro__ if "discover" in vars(kind)) is FrameDriver


def _show_search_error(scheme: str, error: Exception, options: Options) -> None:
    reason = str(error) if isinstance(error, (SmartCamError, OSError)) else repr(error)
    options.show({"scheme": scheme, "error": reason}, f"{scheme}: the search failed: {reason}")


def _source_data(source: FoundSource) -> dict[str, Any]:
    """Return the URL, name, formats and remark of a found source, as values for JSON."""
    return {
        "url": source.url,
        "name": source.name,
        "formats": [
            {
                "format": stream_format.format.name,
                "width": stream_format.width,
                "height": stream_format.height,
                "rates": list(stream_format.rates),
            }
            for stream_format in source.formats
        ],
        "remark": source.remark,
    }


def _source_text(value: dict[str, Any]) -> str:
    lines = [f"{value['url']}  {value['name']}"]
    for entry in value["formats"]:
        rates = ", ".join(f"{rate:g}" for rate in entry["rates"])
        at = f" at {rates}/s" if rates else ""
        lines.append(f"  {entry['format']} {entry['width']}x{entry['height']}{at}")
    if value["remark"]:
        lines.append(f"  {value['remark']}")
    return "\n".join(lines)


# ---------------------------------------------------------------------- grab


def _check_suffix(_context: object, _option: object, file: str) -> str:
    if Path(file).suffix.lower() not in SUFFIXES:
        raise click.BadParameter(f"{file}: expected a name that ends with {', '.join(SUFFIXES)}")
    return file


@frames.command(
    help="Write the newest frame to a file, or several. The suffix sets the format: .png and .jxl "
    "(JPEG XL) lose nothing, with 16 bits if the camera sends more than 8; .jpg; .npy (the "
    "array of numpy) and .raw have the pixels as the camera sends them. JPEGs of a camera "
    'are written unchanged. Needs the extra "frames", except for .npy and .raw.'
)
@click.argument("url")
@option("--output", required=True, callback=_check_suffix)
@option("--force")
@option(
    "--count",
    type=click.IntRange(1, MAX_FILES),
    help="Number of frames to write; with several, the names get numbers.",
)
@click.option(
    "--after-now",
    is_flag=True,
    help="Write the first frame whose exposure begins after the request.",
)
@click.option(
    "--trigger",
    is_flag=True,
    help="Trigger the device by software for each frame, and write the triggered picture. The "
    "URL must set the device to triggers, such as gige://HOST?trigger=Software.",
)
@click.option("--grey", is_flag=True, help="Keep only the brightness.")
@click.option("--8-bit", "eight_bits", is_flag=True, help="Keep the upper 8 of more than 8 bits.")
@click.option(
    "--quality",
    type=click.IntRange(1, 100),
    default=90,
    show_default=True,
    help="Quality of a JPEG that is made here.",
)
@option("--timeout", help=TIMEOUT)
@async_command(*OUTPUT_OPTIONS)
async def grab(
    url: str,
    output: str,
    force: bool,
    after_now: bool,
    trigger: bool,
    grey: bool,
    eight_bits: bool,
    quality: int,
    options: Options,
) -> None:
    from smartcam.frames._inside import FRAME_TIMEOUT

    suffix = Path(output).suffix.lower()
    if trigger and after_now:
        raise click.UsageError("--trigger includes --after-now: leave --after-now out")
    if suffix == ".raw" and (grey or eight_bits):
        raise click.UsageError("a .raw file has the bytes as they came: no --grey or --8-bit")
    files = numbered_names(output, options.count or 1)
    _check_output_paths(files, force)
    encoding = Encoding(suffix, quality, grey, eight_bits)
    async with make_source(url, options) as source, source.reader() as reader:
        timeout = options.step_timeout(FRAME_TIMEOUT)
        if trigger:
            next_frame: Any = source.trigger(timeout=timeout)
        else:
            next_frame = (
                reader.after(time.monotonic(), timeout=timeout) if after_now else anext(reader)
            )
        frame = await _await_frame(next_frame, source, 0, len(files))
        for written_count, file in enumerate(files, 1):
            data = await asyncio.to_thread(encoding.encode, frame)
            await asyncio.to_thread(_write, file, data)
            options.show(*_describe_file(file, len(data), frame))
            if written_count < len(files):
                next_frame = source.trigger(timeout=timeout) if trigger else anext(reader)
                frame = await _await_frame(next_frame, source, written_count, len(files))
        statistics = reader.statistics()
    if len(files) > 1 and not trigger and (statistics.skipped or statistics.lost):
        click.echo(f"note: {statistics.skipped} skipped, {statistics.lost} lost", err=True)


async def _await_frame(next_frame: Any, source: FrameSource, count: int, expected: int) -> Frame:
    """Return the next frame; if the source has ended, raise an error with the count so far."""
    try:
        frame: Frame = await next_frame
    except StopAsyncIteration:
        raise FrameSourceError(
            f"{source.name}: it ended after {count} frames; expected {expected}", source=source.name
        ) from None
    return frame


def _describe_file(file: str, size: int, frame: Frame) -> tuple[dict[str, Any], str]:
    """Return the description of a written frame, as values for JSON and as text."""
    value = {
        "file": file,
        "size": size,
        "source": frame.source,
        "format": frame.format.name,
        "width": frame.width,
        "height": frame.height,
        "stride": frame.stride,
        "sequence": frame.sequence,
        "lost": frame.lost,
        "captured": datetime.fromtimestamp(frame.utc, UTC),
        "moment": frame.moment.value,
    }
    if frame.trigger is not None:
        value["evidence"] = [*frame.trigger.evidence]
    text = (
        f"{file}: {frame.format.name} {frame.width}x{frame.height}, number {frame.sequence}, "
        f"{size:,} bytes"
    )
    return value, text


def _check_output_paths(files: Sequence[str], force: bool) -> None:
    """Raise ConfigurationError if the folder is missing, or a file must not be replaced."""
    folder = Path(files[0]).parent
    if not folder.is_dir():
        raise ConfigurationError(f"{files[0]}: there is no folder {folder}")
    existing = next((file for file in files if Path(file).exists()), None)
    if existing is not None and not force:
        raise ConfigurationError(f"{existing}: the file exists already; --force replaces it")


def _write(file: str, data: bytes) -> None:
    try:
        Path(file).write_bytes(data)
    except OSError as exc:
        raise ConfigurationError(f"{file}: cannot be written: {exc.strerror}") from exc


# ---------------------------------------------------------------------- measure


@frames.command(
    name="measure",
    help="Read a source for some seconds and report its rate and jitter, the age of arriving "
    "frames, lost and skipped frames, and the CPU load of this process. The latency is "
    "measured by the stamp that synthetic:// on this machine draws into its pictures; they may "
    "come through any camera or codec.",
)
@click.argument("url")
@option("--seconds", default=5.0, show_default=True, help="Seconds from the first frame on.")
@option("--timeout", help=TIMEOUT)
@async_command(*OUTPUT_OPTIONS)
async def measure_command(url: str, options: Options) -> None:
    from smartcam.models import jsonable

    async with make_source(url, options) as source:
        value = await measure(source, options.seconds or 5.0)
    options.show(jsonable(value), measurement_text)


frames.add_command(colours)
