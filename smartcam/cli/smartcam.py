"""The ``smartcam`` command."""

from __future__ import annotations

import asyncio
import shlex
from typing import TYPE_CHECKING, Any

import click

import smartcam
from smartcam._client.handshake import load_protocol
from smartcam.cli import calibrate, demo, demo_pick, dissector, record, sheet
from smartcam.cli.decode import decode as decode_data
from smartcam.cli.decode import from_hex
from smartcam.cli.doctor import doctor as examine
from smartcam.cli.options import (
    CONNECTS,
    SECONDS,
    Options,
    application,
    camera_options,
    output_options,
    result_options,
)
from smartcam.cli.probe import probe as probe_camera
from smartcam.cli.running import run
from smartcam.cli.texts import application_text, result_text, table_text
from smartcam.client import DEFAULT_TRIGGER_TIMEOUT
from smartcam.exceptions import (
    NotRunningError,
    PluginError,
    SmartCamError,
    TriggerTimeoutError,
    UnsupportedError,
)
from smartcam.interpreters import resolve
from smartcam.models import Status
from smartcam.protocols.bvs import BVS
from smartcam.registry import INTERPRETERS, PROTOCOLS

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.registry import PluginInfo

__all__ = ["command"]

EPILOG = (
    "Exit codes: 0 done; 1 a fault of ours; 2 wrong usage, a bad layout text included; 3 no "
    "session: nothing listens, silence or garbage, connection lost; 4 a wait in a session ran "
    "out; 5 the camera refused or is not running; 6 a result is not interpretable; 7 a calibration "
    "that was checked is stale."
)


@click.group(epilog=EPILOG, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(smartcam.__version__)
def command() -> None:
    """Talk to industrial smart cameras.

    A camera is named by its URL: bvs://HOST[:PORT] over TCP, bvs+udp://HOST[:PORT] over UDP,
    insight://[USER[:PASSWORD]@]HOST[:PORT]; ?dialect=NAME pins what is otherwise found out (see
    "smartcam protocols").
    """


@command.command(
    help="Find out how a camera speaks; HOST or URL. Tries transports and dialects, the most "
    f"probable first, until one is answered; --timeout bounds all of it. {CONNECTS}"
)
@click.argument("host_or_url")
@click.option("--all", "go_on", is_flag=True, help="Try the rest too where one is answered.")
@camera_options
def probe(host_or_url: str, go_on: bool, **shared: Any) -> None:
    options = Options(**shared)
    run(probe_camera(host_or_url, options, go_on=go_on), program="smartcam", debug=options.debug)


@command.command(
    help="Say what is wrong, in plain words and with the cure: name, session, status, application, "
    "round trip, run state, results, clock. Changes nothing on the camera and triggers nothing, "
    f"unless --trigger is given. Exit code: that of the worst finding. {CONNECTS}"
)
@click.argument("url")
@click.option(
    "--trigger",
    "with_triggers",
    is_flag=True,
    help="Send triggers; load and start --application for them, and go back afterwards.",
)
@click.option(
    "--application",
    type=click.IntRange(0, 0xFFFFFFFF),
    help="The application that should be active; only compared, unless --trigger is given.",
)
@click.option(
    "--interpret-as", metavar="SPEC", help="Compare results with this layout or interpreter."
)
@click.option("--y-down", is_flag=True, help="The camera's y axis points down.")
@click.option("--count", type=click.IntRange(1, 10_000), help="How many triggers; 10 by default.")
@click.option(
    "--seconds", type=SECONDS, help="How long to watch what comes by itself; 3 by default."
)
@camera_options
def doctor(url: str, with_triggers: bool, **shared: Any) -> None:
    options = Options(**shared)

    async def main() -> None:
        code = await examine(url, options, trigger=with_triggers)
        if code:
            raise SystemExit(code)

    run(main(), program="smartcam", debug=options.debug)


@command.command(help=f"Show a camera's status; changes nothing on it. {CONNECTS}")
@click.argument("url")
@camera_options
def status(url: str, **shared: Any) -> None:
    _then_show(url, Options(**shared), None)


@command.command(
    help="Trigger and print the result. Without --application nothing is started: a stopped "
    f"camera is an error (exit code 5). {CONNECTS}"
)
@click.argument("url")
@click.option("--input", "input_hex", metavar="HEX", help="Input data for each inspection.")
@result_options
def trigger(url: str, input_hex: str | None, **shared: Any) -> None:
    options = Options(**shared)
    run(_trigger(url, input_hex, options), program="smartcam", debug=options.debug)


async def _trigger(url: str, input_hex: str | None, options: Options) -> None:
    data = None if input_hex is None else from_hex(input_hex, "--input")
    timeout = options.step(DEFAULT_TRIGGER_TIMEOUT)
    loop = asyncio.get_running_loop()
    with options.camera(url) as unopened:
        async with unopened as camera:
            end = loop.time() + options.seconds if options.seconds else None
            count = options.count or (None if end else 1)
            done = 0
            while (count is None or done < count) and (end is None or loop.time() < end):
                try:
                    result = await camera.trigger(input=data, timeout=timeout)
                except NotRunningError as exc:
                    url = shlex.quote(camera.url)
                    raise NotRunningError(
                        f"{exc}. To start it: smartcam start {url}, or trigger with "
                        f"--application {camera.active_application}"
                    ) from exc
                options.show(result, result_text)
                done += 1


@command.command(
    help="Print results as they come, until Ctrl-C, --count or --seconds. With --count each "
    f"result must come within --timeout. {CONNECTS}"
)
@click.argument("url")
@result_options
def watch(url: str, **shared: Any) -> None:
    options = Options(**shared)
    run(_watch(url, options), program="smartcam", debug=options.debug, interrupted=0)


async def _watch(url: str, options: Options) -> None:
    each = options.step(DEFAULT_TRIGGER_TIMEOUT) if options.count else None
    with options.camera(url) as unopened:
        # subscribed before the session is there, so the first result is seen too
        results = unopened.results()
        async with unopened as camera:
            if not camera.capabilities.unasked_results:
                raise UnsupportedError(
                    f"{camera.name}: the camera sends no results by itself; to have some: "
                    f"smartcam trigger {shlex.quote(camera.url)} --count N"
                )
            done = 0
            try:
                async with asyncio.timeout(options.seconds):
                    while options.count is None or done < options.count:
                        try:
                            async with asyncio.timeout(each):
                                result = await anext(results)
                        except TimeoutError as exc:
                            raise TriggerTimeoutError(
                                f"{camera.name}: no result within {each:g} s; "
                                f"status: {camera.status}"
                            ) from exc
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
@camera_options
def switch(url: str, id_or_file: int | str, **shared: Any) -> None:
    _then_show(url, Options(**shared), lambda camera: camera.switch_application(id_or_file))


@command.command(help=f"Enter run mode; returns when the camera is ready. {CONNECTS}")
@click.argument("url")
@camera_options
def start(url: str, **shared: Any) -> None:
    options = Options(**shared)
    _then_show(url, options, lambda camera: camera.start(timeout=options.step(10.0)))


@command.command(help=f"Leave run mode; returns when the camera has stopped. {CONNECTS}")
@click.argument("url")
@camera_options
def stop(url: str, **shared: Any) -> None:
    options = Options(**shared)
    _then_show(url, options, lambda camera: camera.stop(timeout=options.step(10.0)))


@command.command(
    help="Decode DATA: hex, the name of a file (binary or hex text), or - for standard input. "
    "Frames are shown field by field (those without a magic number need --dialect); anything else "
    "is a result container's data and needs --interpret-as."
)
@click.argument("data")
@click.option("--interpret-as", metavar="SPEC", help="How to read a result container's data.")
@click.option("--big-endian", is_flag=True, help="The container is big endian.")
@click.option("--dialect", type=click.Choice(tuple(BVS.dialects)), help="Whose frames they are.")
@click.option("--quirks", metavar="NAMES", default="", help="The dialect's quirks, as in a URL.")
@output_options
def decode(
    data: str,
    interpret_as: str | None,
    big_endian: bool,
    dialect: str | None,
    quirks: str,
    **shared: Any,
) -> None:
    options = Options(interpret_as=interpret_as, **shared)

    async def main() -> None:
        decode_data(data, options, big_endian=big_endian, dialect_name=dialect, quirks=quirks)

    run(main(), program="smartcam", debug=options.debug)


@command.command()
@output_options
def protocols(**shared: Any) -> None:
    """List the protocols and their dialects."""
    options = Options(**shared)

    async def main() -> None:
        for info in PROTOCOLS.available():
            try:
                value, text = _protocol(info)
            except Exception as exc:  # noqa: BLE001 - a broken plug-in costs only its own line
                value, text = _broken(info, exc)
            options.show(value, text)

    run(main(), program="smartcam", debug=options.debug)


def _protocol(info: PluginInfo) -> tuple[object, str]:
    """Return what is shown of a protocol, as JSON and as text."""
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
    """Return what is shown of a plug-in that cannot be used."""
    reason = str(exc) if isinstance(exc, SmartCamError) else repr(exc)
    value = {**info._asdict(), "error": reason}
    return value, f"{info.name}  ({info.origin}: {info.target}) cannot be used: {reason}"


@command.command()
@output_options
def interpreters(**shared: Any) -> None:
    """List the interpreters that --interpret-as knows."""
    options = Options(**shared)

    async def main() -> None:
        for info in INTERPRETERS.available():
            value: object = info
            text = f"{info.name}  ({info.origin}: {info.target})"
            try:
                resolve(info.name)
            except PluginError as exc:
                value, text = _broken(info, exc)
            except SmartCamError:
                pass  # it has need of a layout
            options.show(value, text)

    run(main(), program="smartcam", debug=options.debug)


@command.command(name="demo")
@click.option(
    "--pick",
    is_flag=True,
    help="Calibrate a simulated robot against the camera instead, and pick seven parts with it.",
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
    help="With --pick: of all noise, and of where the table is.",
)
@output_options
def demo_command(pick: bool, picture: str, seed: int, **shared: Any) -> None:
    """Watch smartcam do its main job against an emulated camera over real TCP."""
    options = Options(**shared)
    main = demo_pick.pick(options, picture, seed) if pick else demo.demo(options)
    run(main, program="smartcam", debug=options.debug)


command.add_command(calibrate.calibrate)
command.add_command(dissector.dissector)
command.add_command(record.record)
command.add_command(record.replay)
command.add_command(record.pcap)
command.add_command(sheet.sheet)


def _then_show(
    url: str,
    options: Options,
    action: Callable[[smartcam.SmartCamera], Awaitable[None]] | None,
) -> None:
    """Connect, do something, show how the camera is then."""

    async def main() -> None:
        with options.camera(url) as unopened:
            async with unopened as camera:
                if action is not None:
                    await action(camera)
                _show_camera(camera, options)

    run(main(), program="smartcam", debug=options.debug)


def _show_camera(camera: smartcam.SmartCamera, options: Options) -> None:
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
