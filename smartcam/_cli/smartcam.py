"""The ``smartcam`` command."""

from __future__ import annotations

import asyncio
import inspect
import re
import shlex
from typing import TYPE_CHECKING

import click

import smartcam
from smartcam._cli import demo, demo_fleet, demo_pick
from smartcam._cli.calibrate import calibrate
from smartcam._cli.decode import decode, from_hex
from smartcam._cli.depth import depth
from smartcam._cli.dissector import dissector
from smartcam._cli.doctor import doctor
from smartcam._cli.fleet import fleet
from smartcam._cli.frames import frames
from smartcam._cli.image import image
from smartcam._cli.live import live, serve_page
from smartcam._cli.options import CAMERA, CONNECTS, OUTPUT, RESULTS, Options, application, runs
from smartcam._cli.page import PageOptions, page_options
from smartcam._cli.probe import probe
from smartcam._cli.record import bag, pcap, record, replay
from smartcam._cli.ros1 import ros1
from smartcam._cli.ros2 import ros2
from smartcam._cli.running import JsonErrors
from smartcam._cli.serve import serve
from smartcam._cli.sheet import sheet
from smartcam._cli.terminal import counting
from smartcam._cli.texts import application_text, not_running, result_text, table_text
from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT
from smartcam.exceptions import (
    NotRunningError,
    PluginError,
    SmartCamError,
    TriggerTimeoutError,
    UnsupportedError,
)
from smartcam.interpreters import resolve
from smartcam.models import Status
from smartcam.protocols._base import load_protocol
from smartcam.registry import INTERPRETERS, PROTOCOLS
from smartcam.settings import is_fleet

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping, Sequence

    from smartcam.registry import PluginInfo

EPILOG = (
    "Exit codes: 0 done; 1 a fault of ours; 2 wrong usage, a bad layout text included; 3 no "
    "session: nothing listens, silence or garbage, connection lost, no such source of frames; 4 a "
    "wait in a session, or for a frame, ran out; 5 the camera refused, is not running or has no "
    "such pixels; 6 a result is not interpretable; 7 a calibration that was checked is stale, or "
    "two differ."
)


TOPICS: Mapping[str, Sequence[str]] = {
    "A camera": ("trigger", "watch", "live", "image", "status", "start", "stop", "switch"),
    "A fleet": ("serve", "fleet", "ros2", "ros1"),
    "Pictures": ("frames", "depth"),
    "Finding out": ("doctor", "probe", "protocols", "interpreters", "decode"),
    "A robot": ("calibrate", "sheet"),
    "Recordings": ("record", "replay", "pcap", "bag", "dissector"),
    "Without a camera": ("demo",),
}
"""What ``--help`` lists where."""


class CommandsByTopic(JsonErrors, click.Group):
    """The commands, listed by topic with whole summaries."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list."""
        for topic, names in TOPICS.items():
            with formatter.section(topic):
                rows = [(name, self.commands[name].get_short_help_str(limit=400)) for name in names]
                formatter.write_dl(rows)


@click.group(
    cls=CommandsByTopic, epilog=EPILOG, context_settings={"help_option_names": ["-h", "--help"]}
)
@click.version_option(smartcam.__version__)
def command() -> None:
    """Talk to industrial smart cameras.

    A camera is named by its URL: bvs://HOST[:PORT] over TCP, bvs+udp://HOST[:PORT] over UDP,
    insight://[USER[:PASSWORD]@]HOST[:PORT]; ?dialect=NAME pins what is otherwise found out (see
    "smartcam protocols"). fleet://HOST[:PORT]/NAME is a camera that "smartcam serve" shares with
    any number of programs.
    """


@command.command(help=f"Show a camera's status; changes nothing on it. {CONNECTS}")
@click.argument("url")
@runs(*CAMERA)
async def status(url: str, options: Options) -> None:
    await _then_show(url, options)


@command.command(
    help="Trigger and print the result. Without --application nothing is started: a stopped "
    f"camera is an error (exit code 5). {CONNECTS}"
)
@click.argument("url")
@click.option("--input", "input_hex", metavar="HEX", help="Input data for each inspection.")
@runs(*RESULTS)
async def trigger(url: str, input_hex: str | None, options: Options) -> None:
    data = None if input_hex is None else from_hex(input_hex, "--input")
    timeout = options.step(DEFAULT_TRIGGER_TIMEOUT)
    loop = asyncio.get_running_loop()
    with options.camera(url) as unopened:
        options.remark(unopened)
        async with unopened as camera:
            end = loop.time() + options.seconds if options.seconds else None
            count = options.count or (None if end else 1)
            done = 0
            while (count is None or done < count) and (end is None or loop.time() < end):
                try:
                    result = await camera.trigger(input=data, timeout=timeout)
                except NotRunningError as exc:
                    raise not_running(exc, camera, "trigger") from exc
                options.show(result, result_text)
                done += 1


@command.command(
    help="Print results as they come, until Ctrl-C, --count or --seconds. With --count each "
    f"result must come within --timeout. {CONNECTS}"
)
@click.argument("url")
@page_options("Show a page instead, as smartcam live does; its address goes to stdout.")
@runs(*RESULTS, interrupted=0)
async def watch(url: str, web: PageOptions, options: Options) -> None:
    if web.wanted:
        if options.count:
            raise click.UsageError("--count and --web do not go together")
        await serve_page(url, web, options)
        return
    each = options.step(DEFAULT_TRIGGER_TIMEOUT) if options.count else None
    with options.camera(url) as unopened:
        # subscribed before the session is there, so the first result is seen too
        results = unopened.results()
        async with unopened as camera:
            if not (camera.capabilities.unasked_results or is_fleet(url)):
                raise UnsupportedError(
                    f"{camera.name}: the camera sends no results by itself; to have some: "
                    f"smartcam trigger {shlex.quote(camera.url)} --count N"
                )
            done = 0
            try:
                async with counting(camera) as line, asyncio.timeout(options.seconds):
                    while options.count is None or done < options.count:
                        try:
                            async with asyncio.timeout(each):
                                result = await anext(results)
                        except TimeoutError as exc:
                            raise TriggerTimeoutError(
                                f"{camera.name}: no result within {each:g} s; "
                                f"status: {camera.status}"
                            ) from exc
                        line.clear()
                        options.show(result, result_text)
                        done += 1
            except TriggerTimeoutError:
                raise
            except TimeoutError:
                pass  # --seconds are over


@command.command(
    help="Load another application by its id, or by the name of its file where the camera can do "
    f"that; returns when the camera is ready. It runs if the one before ran. {CONNECTS}"
)
@click.argument("url")
@click.argument("id_or_file", metavar="ID|FILE", type=application)
@runs(*CAMERA)
async def switch(url: str, id_or_file: int | str, options: Options) -> None:
    await _then_show(url, options, lambda camera: camera.switch_application(id_or_file))


@command.command(help=f"Enter run mode; returns when the camera is ready. {CONNECTS}")
@click.argument("url")
@runs(*CAMERA)
async def start(url: str, options: Options) -> None:
    await _then_show(url, options, lambda camera: camera.start(timeout=options.step(10.0)))


@command.command(help=f"Leave run mode; returns when the camera has stopped. {CONNECTS}")
@click.argument("url")
@runs(*CAMERA)
async def stop(url: str, options: Options) -> None:
    await _then_show(url, options, lambda camera: camera.stop(timeout=options.step(10.0)))


@command.command()
@runs(*OUTPUT)
async def protocols(options: Options) -> None:
    """List the protocols and their dialects."""
    for info in PROTOCOLS.available():
        try:
            value, text = _protocol(info)
        except Exception as exc:  # noqa: BLE001 - a broken plug-in costs only its own line
            value, text = _broken(info, exc)
        options.show(value, text)


def _protocol(info: PluginInfo) -> tuple[object, str]:
    """Describe a protocol, as JSON and as text."""
    protocol = load_protocol(info.name)
    value = {
        "name": protocol.name,
        "origin": info.origin,
        "schemes": list(protocol.schemes),
        "default_port": protocol.default_port,
        "models": list(protocol.models),
        "dialects": [
            {"name": d.name, "about": d.about, "source": d.source}
            for d in protocol.dialects.values()
        ],
        "parameters": protocol.parameters,
    }
    rows = [(d.name, d.about) for d in protocol.dialects.values()]
    head = (
        f"{info.name} ({info.origin}): {', '.join(f'{s}://' for s in protocol.schemes)}, "
        f"port {protocol.default_port}, models {', '.join(protocol.models)}\n"
    )
    return value, head + table_text(("dialect", ""), rows)


def _broken(info: PluginInfo, exc: Exception) -> tuple[object, str]:
    """Describe a plug-in that cannot be used."""
    reason = str(exc) if isinstance(exc, SmartCamError) else repr(exc)
    value = {**info._asdict(), "error": reason}
    return value, f"{info.name}  ({info.origin}: {info.target}) cannot be used: {reason}"


@command.command()
@runs(*OUTPUT)
async def interpreters(options: Options) -> None:
    """List the interpreters that --interpret-as knows."""
    for info in INTERPRETERS.available():
        options.show(*_interpreter(info))


def _interpreter(info: PluginInfo) -> tuple[object, str]:
    """Describe an interpreter, as JSON and as text."""
    about = ""
    try:
        about = _first_line(INTERPRETERS.load(info.name))
        resolve(info.name)
    except PluginError as exc:
        return _broken(info, exc)
    except SmartCamError:
        pass  # it has need of a layout
    where = "" if info.origin == "built-in" else f" ({info.origin}: {info.target})"
    return {**info._asdict(), "about": about}, f"{info.name:14} {about}{where}"


def _first_line(loaded: object) -> str:
    """Return the first line of what a plug-in says of itself, without its markup."""
    lines = (inspect.getdoc(loaded) or "").splitlines()
    return re.sub(r":[a-z]+:`~?(?:[\w.]*\.)?(\w+)`|`+", r"\1", lines[0]) if lines else ""


@command.command(name="demo")
@click.option(
    "--pick",
    is_flag=True,
    help="Calibrate a simulated robot against the camera instead, and pick seven parts with it.",
)
@click.option(
    "--fleet",
    "shared",
    is_flag=True,
    help="Have two agents share ten cameras, and three programs one of them, instead. Needs the "
    'extra "fleet".',
)
@click.option(
    "--tower",
    is_flag=True,
    help="Have a simulated robot with a camera at its hand build a tower of the black blocks that "
    'it finds, instead. Needs the extra "depth".',
)
@click.option(
    "--picture",
    type=click.Path(dir_okay=False),
    default="pick.svg",
    show_default=True,
    help="With --pick: where the picture of the calibration goes (SVG).",
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=1,
    show_default=True,
    help="With --pick and --tower: of all noise, and of where things are.",
)
@runs(*OUTPUT)
async def demo_command(
    pick: bool, shared: bool, tower: bool, picture: str, seed: int, options: Options
) -> None:
    """Watch smartcam do its main job against an emulated camera over real TCP."""
    asked = {"--pick": pick, "--fleet": shared, "--tower": tower}
    given = [name for name, wanted in asked.items() if wanted]
    if len(given) > 1:
        raise click.UsageError(f"{' and '.join(given)} do not go together")
    if tower:
        from smartcam._cli import demo_tower  # it stands on numpy

        await demo_tower.tower(options, seed)
    elif shared:
        await demo_fleet.demo(options)
    else:
        await (demo_pick.pick(options, picture, seed) if pick else demo.demo(options))


for _one in (
    *(live, probe, doctor, image, decode, calibrate, sheet),
    *(record, replay, pcap, bag, dissector, serve, fleet, ros2, ros1, frames, depth),
):
    command.add_command(_one)


async def _then_show(
    url: str,
    options: Options,
    action: Callable[[smartcam.Camera], Awaitable[None]] | None = None,
) -> None:
    """Connect, do something, show how the camera is then."""
    with options.camera(url) as unopened:
        async with unopened as camera:
            if action is not None:
                await action(camera)
            _show_camera(camera, options)


def _show_camera(camera: smartcam.Camera, options: Options) -> None:
    value = {
        "camera": camera.name,
        "url": camera.url,
        "status": camera.status,
        "active_application": camera.active_application,
        "protocol_version": camera.protocol_version,
    }
    running = "running" if Status.RUNNING in camera.status else "stopped"
    active = application_text(camera.active_application)
    options.show(
        value,
        f"{camera.url}\n  {active}, {running}\n"
        f"  status: {camera.status}\n  protocol version {camera.protocol_version}",
    )
