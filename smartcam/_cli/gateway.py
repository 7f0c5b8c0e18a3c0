"""``smartcam gateway``: answer robots and PLCs with the workpieces that a camera finds."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
from typing import TYPE_CHECKING, Any

import click

from smartcam._cli.options import CAMERA_OPTIONS, CONNECT_WARNING, SECONDS, Options, async_command
from smartcam.backoff import Backoff

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from smartcam.camera import Camera
    from smartcam.gateway import Gateway, GatewaySettings
    from smartcam.gateway._inside import GatewayFile

DEMO_APPLICATION = 7
"""The application of the emulated camera that localizes parts."""


def _style_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options for the form of answers to the command."""
    decorators = [
        click.option(
            "--listen",
            metavar="tcp/HOST:PORT",
            help="Address for robots.  [default: tcp/127.0.0.1:7001]",
        ),
        click.option(
            "--robot",
            type=click.Choice(["plain", "ur", "kuka", "fanuc", "siemens"]),
            help="Brand of the controller, which sets the defaults below.  [default: plain]",
        ),
        click.option("--form", type=click.Choice(["text", "brackets", "xml"])),
        click.option(
            "--pose",
            type=click.Choice(["ur", "abb", "kuka", "fanuc", "meca500"]),
            help="Brand of robot whose convention for orientations is used.",
        ),
        click.option("--length", type=click.Choice(["m", "mm"])),
        click.option("--angle", type=click.Choice(["rad", "deg"])),
        click.option("--decimals", type=click.IntRange(0, 9)),
        click.option("--separator", metavar="CHARACTER"),
        click.option("--line-end", type=click.Choice(["lf", "crlf", "cr", "none"])),
        click.option("--width", type=click.IntRange(0, 1000), help="Bytes of each answer, padded."),
        click.option(
            "--also",
            multiple=True,
            type=click.Choice(["quality", "photo_index", "feature_id"]),
            help="Value that follows the pose; repeatable.",
        ),
        click.option("--tool-flip", is_flag=True, help="Make z point into the table, as a tool's."),
        click.option("--max-age", type=SECONDS, help="Largest age of a result for NEXT, seconds."),
        click.option("--idle", type=SECONDS, help="Seconds until a silent robot is disconnected."),
        click.option("--clients", type=click.IntRange(1, 100), help="How many robots at a time."),
    ]
    for option in reversed(decorators):
        command = option(command)
    return command


@click.command(
    help="Answer robots and PLCs that ask for parts, line by line over TCP, until Ctrl-C. A "
    "controller sends TRIGGER, then NEXT for each further part; --timeout bounds each "
    "answer. CAMERA is a URL, or a YAML file with all the options. --demo uses an emulated "
    f'camera. Needs the extra "calibration". {CONNECT_WARNING}'
)
@click.argument("camera", metavar="[URL|FILE.yaml]", required=False)
@click.option("--demo", is_flag=True, help="Use an emulated camera instead of CAMERA.")
@_style_options
@async_command(
    *("--application", "--interpret-as", "--y-down", "--calibration", "--name", "--seconds"),
    *CAMERA_OPTIONS,
    interrupt_code=0,
)
async def gateway(camera: str | None, demo: bool, options: Options, **style: Any) -> None:
    """Answer robots."""
    from smartcam.gateway import Gateway

    file = _read_file(camera, demo)
    settings = _make_settings(file, style, options)
    _fill_missing_options(options, file)
    async with contextlib.AsyncExitStack() as stack:
        url = file.url
        if url is None:
            url = await stack.enter_async_context(_emulated_camera(options))
        make_camera = stack.enter_context(options.cameras(url, reconnect=Backoff()))
        first = make_camera()
        server = await stack.enter_async_context(Gateway(first, settings))
        stack.callback(_print_counts, server, options)

        def show() -> None:
            value = {"gateway": server.address, "camera": url}
            options.show(value, f"gateway: {server.address}  camera: {url}")

        with contextlib.suppress(TimeoutError):  # --seconds are over
            async with asyncio.timeout(options.seconds):
                await _ensure_open(server, make_camera, show)


async def _ensure_open(
    server: Gateway, make_camera: Callable[[], Camera], show: Callable[[], None]
) -> None:
    """Keep the camera open; show the gateway after the first try to open it."""
    from smartcam._cli.live import keep_open

    first, was_shown = server.camera, False

    def on_first_try() -> None:
        nonlocal was_shown
        if not was_shown:
            show()
        was_shown = True

    async def replace_camera(camera: Camera, reason: str) -> None:
        if server.camera is first:
            click.echo(f"note: {reason}; trying again", err=True)
        server.camera = camera
        on_first_try()

    await keep_open(first, make_camera, replace_camera, on_first_try)


def _read_file(camera: str | None, demo: bool) -> GatewayFile:
    from smartcam.gateway._inside import GatewayFile

    if demo == (camera is not None):
        raise click.UsageError(
            "expected a camera's URL, a YAML file, or --demo: smartcam gateway URL"
        )
    if camera is None:
        return GatewayFile(emulated=True)
    return GatewayFile(url=camera) if "://" in camera else GatewayFile.load(camera)


def _make_settings(file: GatewayFile, style: dict[str, Any], options: Options) -> GatewaySettings:
    from pydantic import ValidationError

    from smartcam.exceptions import ConfigurationError

    set_style = {name: value for name, value in style.items() if value not in (None, (), False)}
    if options.timeout is not None:
        set_style["timeout"] = options.timeout
    try:
        return file.settings(**set_style)
    except ValidationError as exc:
        (first, *_) = exc.errors()
        option_text = "".join(f"--{option}: " for option in first["loc"][:1]).replace("_", "-")
        raise ConfigurationError(option_text + first["msg"].removeprefix("Value error, ")) from exc


def _fill_missing_options(options: Options, file: GatewayFile) -> None:
    """Set the options that are missing on the command line to the values of the file."""
    from smartcam.settings import is_fleet

    for name in ("application", "interpret_as", "calibration", "name"):
        if getattr(options, name) is None:
            setattr(options, name, getattr(file, name))
    options.y_down = options.y_down or file.y_down
    if options.interpret_as is None and not is_fleet(file.url or ""):
        options.interpret_as = "localizations"


@contextlib.asynccontextmanager
async def _emulated_camera(options: Options) -> AsyncIterator[str]:
    """Yield the URL of an emulated camera, whose parts do not move."""
    from smartcam.emulator import EmulatedCamera

    if options.application is None:
        options.application = DEMO_APPLICATION
    async with EmulatedCamera() as emulator:
        yield emulator.url


def _print_counts(server: Gateway, options: Options) -> None:
    """Print the counts of all requests and parts."""
    counts = server.counts
    if options.as_json:
        options.show({"counts": dataclasses.asdict(counts)}, "")
        return
    click.echo(
        f"requests {counts.requests} = answered {counts.answered} + errors {counts.errors} + "
        f"abandoned {counts.abandoned} + open {counts.open}; parts {counts.parts} = delivered "
        f"{counts.delivered} + forgotten {counts.forgotten} + waiting {counts.waiting}",
        err=True,
    )
