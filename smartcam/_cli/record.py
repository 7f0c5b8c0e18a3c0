"""``smartcam record``, ``replay``, ``pcap``, ``bag``: a camera's run in a file, and out of it."""

from __future__ import annotations

import asyncio
import contextlib
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from smartcam._cli.options import CONNECTS, OUTPUT, SECONDS, Options, option, runs
from smartcam._cli.running import first
from smartcam._cli.serve import share
from smartcam._cli.terminal import counting
from smartcam._cli.texts import camera_value, not_running
from smartcam.backoff import Backoff
from smartcam.exceptions import (
    CameraFaultError,
    ConfigurationError,
    ConnectionClosedError,
    ConnectionLostError,
    ConnectionTakenError,
    InterpretationError,
    NotRunningError,
    ResponseTimeoutError,
    TriggerError,
    UnsupportedError,
)

if TYPE_CHECKING:
    from collections.abc import Coroutine

    from smartcam.camera import Camera
    from smartcam.recording import BagCounts, FleetReplay, Recorder, Recording


def _time(_ctx: click.Context, _param: click.Parameter, value: str | None) -> datetime | None:
    """Return a time with its zone."""
    try:
        return None if value is None else datetime.fromisoformat(value).astimezone(UTC)
    except (ValueError, OverflowError) as exc:
        raise click.BadParameter(f"{value!r} is no time such as 2026-01-02T03:04:05Z") from exc


_camera = click.option(
    "--camera", metavar="NAME", help="Which camera of the recording; default all of them."
)


@click.command(
    help="Record everything a camera says to an MCAP file, until Ctrl-C, --count or --seconds: "
    "frames, results, events, errors; of a fleet's camera no frames, and the results of every "
    "program's triggers. With --bag also, or only, as a rosbag2 for ROS 2. A lost link is made "
    "again, and the recording goes on. "
    f"{CONNECTS}"
)
@click.argument("url")
@option("--output")
@click.option(
    "--bag",
    metavar="FOLDER",
    type=click.Path(),
    help="Write a rosbag2 (MCAP): results, localizations, status and diagnostics as ROS messages.",
)
@option("--force")
@click.option(
    "--every", type=SECONDS, metavar="SECONDS", help="Send a trigger every so many seconds."
)
@option("--name", help="The camera's name in the file; default HOST:PORT.")
@option("--application")
@option("--interpret-as", help="How to read results; default raw: bytes, kept as hex.")
@runs("--y-down", "--count", "--seconds", "--timeout", *OUTPUT, interrupted=0)
async def record(
    url: str,
    output: str | None,
    bag: str | None,
    force: bool,
    every: float | None,
    options: Options,
) -> None:
    """Record a camera."""
    recorders = _recorders(output, bag, force=force)
    with options.camera(url, observers=recorders, reconnect=Backoff()) as unopened:
        await _record(unopened, recorders, every, options)


def _recorders(output: str | None, bag: str | None, *, force: bool) -> list[Recorder]:
    """Return what is to be written."""
    from smartcam.recording import BagRecorder, Recorder

    recorders: list[Recorder] = []
    if output is not None:
        recorders.append(Recorder(output, overwrite=force))
    if bag is not None:
        if output is not None and Path(output).resolve().parent == Path(bag).resolve():
            raise ConfigurationError(f"--output {output}: it would be in the bag's own folder")
        recorders.append(BagRecorder(bag, overwrite=force))
    if not recorders:
        raise click.UsageError("Missing option '-o' / '--output', or '--bag'.")
    return recorders


async def _record(
    unopened: Camera, recorders: list[Recorder], every: float | None, options: Options
) -> None:
    from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT
    from smartcam.fleet import FleetCamera
    from smartcam.ros2._camera_reading import in_pixels, own_interpreter

    opened: list[Recorder] = []
    facts = {name: getattr(options, name) for name in ("interpret_as", "application", "y_down")}
    try:
        for recorder in recorders:
            recorder.open()
            opened.append(recorder)
        options.remark(unopened)
        _describe(recorders, unopened.name, **{name: fact for name, fact in facts.items() if fact})
        # subscribed, so that every container is interpreted
        results = unopened.results(max_queue=1)
        async with unopened as camera:
            if isinstance(camera, FleetCamera):
                # its frames, which would tell, are its agent's
                dialect = camera.capabilities.dialect
                _describe(recorders, camera.name, dialect=dialect, endian=camera.endian)
                # what its agent knows of them, where it was not said here
                read = {name: getattr(camera.settings, name) for name in ("y_down", "lenient")}
                if in_pixels(own_interpreter(camera, camera.active_application)):
                    read["pixels"] = True
                _describe(recorders, camera.name, **{name: on for name, on in read.items() if on})
            elif every is None and not camera.capabilities.unasked_results:
                raise UnsupportedError(
                    f"{camera.name}: the camera sends no results by itself; to have some triggered "
                    "while it is recorded: --every SECONDS"
                )
            paths = {_word(recorder): str(recorder.path) for recorder in recorders}
            options.show(
                {"url": camera.url, **paths},
                f"recording {camera.url} to {' and '.join(paths.values())}, Ctrl-C to end",
            )
            jobs: list[Coroutine[Any, Any, None]] = [*map(_watch_disk, recorders)]
            jobs.append(_count(results, recorders[0], options.count))
            if every is not None:
                jobs.append(_trigger(camera, every, options.step(DEFAULT_TRIGGER_TIMEOUT)))
            async with counting(camera):
                await first(jobs, options.seconds)
    finally:
        await _end_all(opened, unopened, options)


def _describe(recorders: list[Recorder], camera: str, **facts: object) -> None:
    for recorder in recorders:
        recorder.describe(camera, **facts)


def _word(recorder: Recorder) -> str:
    from smartcam.recording import BagRecorder

    return "bag" if isinstance(recorder, BagRecorder) else "file"


async def _watch_disk(recorder: Recorder) -> None:
    raise await recorder.wait_failed()


async def _count(results: Any, recorder: Recorder, count: int | None) -> None:
    """Return when there are so many results; the stream's end is the camera's."""
    while count is None or recorder.counts.results < count:
        try:
            await anext(results)
        except InterpretationError:
            pass  # it is recorded as an error
        except StopAsyncIteration:
            return


async def _trigger(camera: Camera, every: float, timeout: float) -> None:
    """Send triggers; what goes wrong with one is recorded, as long as the first ones went well."""
    loop = asyncio.get_running_loop()
    when, worked = loop.time(), False
    while True:
        try:
            await camera.trigger(timeout=timeout)
            worked = True
        except NotRunningError as exc:
            if not worked:
                raise not_running(exc, camera, "record") from exc
        except (TriggerError, CameraFaultError, InterpretationError, ResponseTimeoutError):
            pass
        except (ConnectionTakenError, ConnectionClosedError):
            raise
        except ConnectionLostError:
            with contextlib.suppress(ResponseTimeoutError):
                await camera.wait_connected()
        # a trigger that took longer than planned leaves some out, and none comes in a hurry
        when += every * max(1, -(-(loop.time() - when) // every))
        await asyncio.sleep(when - loop.time())


async def _end_all(recorders: list[Recorder], camera: Camera, options: Options) -> None:
    """End each file; where one of them failed, the others are ended all the same."""
    async with contextlib.AsyncExitStack() as stack:
        for recorder in reversed(recorders):
            stack.push_async_callback(_end, recorder, camera, options)


async def _end(recorder: Recorder, camera: Camera, options: Options) -> None:
    """End the file, and tell what is in it; without a session there is no file."""
    from smartcam.recording import BagRecorder

    path = recorder.path
    await asyncio.to_thread(recorder.close)
    if isinstance(recorder, BagRecorder):
        if camera.statistics().sessions:
            _show_bag(path, recorder.bag_counts, options)
        else:
            recorder.remove()
    elif camera.statistics().sessions:
        counts, size = recorder.counts._asdict(), path.stat().st_size
        told = ", ".join(f"{kind} {number}" for kind, number in counts.items())
        options.show({"file": str(path), **counts, "bytes": size}, f"{path}: {told}; {size} bytes")
    elif path.is_file() and not path.is_symlink():
        path.unlink()


def _show_bag(path: str | Path, counts: BagCounts, options: Options) -> None:
    told = counts._asdict()
    text = ", ".join(f"{kind} {number}" for kind, number in told.items())
    options.show({"bag": str(path), **told}, f"{path}: {text}")


@click.command(
    help="Emulate the recorded cameras: each trigger gets the recorded containers, byte for byte "
    "and after the same time, and what came by itself comes again. Prints one line per camera, its "
    "URL. When a recording is over its triggers get no result, unless --loop. A folder that an "
    "agent recorded (record: in its fleet file) is played as a fleet: its cameras under their "
    "names, through an agent, whose fleet URLs are printed; --port is the agent's then. A TIME is "
    "2026-01-02T03:04:05, by the local clock unless it ends in Z or +01:00."
)
@click.argument("recording", metavar="RUN.mcap|FOLDER", type=click.Path())
@click.option("--speed", type=float, default=1.0, show_default=True, help="How many times faster.")
@click.option("--loop", is_flag=True, help="Begin again when it is over.")
@click.option(
    "--from", "since", metavar="TIME", callback=_time, help="Play what came from then on."
)
@click.option("--until", metavar="TIME", callback=_time, help="Play what came until then.")
@_camera
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=0,
    show_default=True,
    help="Port; 0 takes a free one. Further cameras take the next ones.",
)
@click.option(
    "--transport", type=click.Choice(("tcp", "udp")), help="Over; default the recorded one."
)
@runs(*OUTPUT, interrupted=0, terminated=0)
async def replay(
    recording: str,
    speed: float,
    loop: bool,
    camera: str | None,
    host: str,
    port: int,
    transport: Literal["tcp", "udp"] | None,
    since: datetime | None,
    until: datetime | None,
    options: Options,
) -> None:
    """Play a recording."""
    from smartcam.recording import FleetReplay
    from smartcam.recording import replay as replay_camera

    loaded = _loaded(recording, since, until)
    if loaded.files != (loaded.path,):
        if transport is not None:
            raise click.UsageError("--transport is for a file: programs come to a folder's agent")
        cameras = None if camera is None else [camera]
        place = f"[{host}]" if ":" in host else host
        played = FleetReplay(
            loaded,
            cameras=cameras,
            speed=speed,
            loop=loop,
            listen=f"tcp/{place}:{port}",
            on_over=_camera_over,
        )
        await _play_fleet(played, options)
        return
    names = list(loaded.cameras) if camera is None else [camera]
    async with contextlib.AsyncExitStack() as stack:
        for index, name in enumerate(names or [None]):
            emulator = replay_camera(
                loaded,
                camera=name,
                speed=speed,
                loop=loop,
                host=host,
                port=port + index if port else 0,
                on_over=_over,
                **({} if transport is None else {"transport": transport}),
            )
            await stack.enter_async_context(emulator)
            options.show({**camera_value(emulator), "camera": emulator.name}, emulator.url)
        await asyncio.Event().wait()


async def _play_fleet(played: FleetReplay, options: Options) -> None:
    """Play a folder, until it is cut off."""
    for name, why in played.skipped.items():
        click.echo(f"smartcam: note: {name} is not played: {why}", err=True)
    async with played:
        await share(played.server, options)


def _camera_over(name: str) -> None:
    click.echo(f"smartcam: note: {name}: the recording is over: nothing of it is left", err=True)


def _over() -> None:
    click.echo("smartcam: note: the recording is over: triggers get no result any more", err=True)


@click.command(
    help="Write a recording's frames as packets for Wireshark: Ethernet, IP, TCP or UDP, with the "
    "recorded times. The client's address and the division into packets are made up."
)
@click.argument("recording", metavar="RUN.mcap", type=click.Path())
@option("--output", required=True)
@option("--force")
@_camera
@runs(*OUTPUT)
async def pcap(
    recording: str, output: str, force: bool, camera: str | None, options: Options
) -> None:
    """Show a recording to Wireshark."""
    from smartcam.recording import write_pcap

    count = write_pcap(_loaded(recording), output, camera=camera, overwrite=force)
    options.show({"file": output, "packets": count}, f"{output}: {count} packets")


@click.command(
    help="Make a rosbag2 of a recording: an MCAP file with ROS 2 messages in a folder, in the "
    "recorded order and with the recorded times. Values are as recorded; with --interpret-as or "
    "--calibration each result's bytes are read again, and those that do not fit go in with why."
)
@click.argument("recording", metavar="RUN.mcap", type=click.Path())
@click.option(
    "-o", "--output", metavar="FOLDER", type=click.Path(), required=True, help="The bag's folder."
)
@option("--force", help="Take the place of a bag that is there.")
@_camera
@option("--interpret-as", help="How to read the results again; default as recorded.")
@runs("--y-down", "--calibration", *OUTPUT)
async def bag(
    recording: str, output: str, force: bool, camera: str | None, options: Options
) -> None:
    """Show a recording to ROS 2."""
    from smartcam.recording._bag_recording import BagConversion

    loaded = _loaded(recording)
    reading = options.reading(fleet=True) if options.calibration or options.y_down else {}
    conversion = BagConversion(
        loaded,
        Path(output),
        camera=camera,
        interpret_as=options.interpret_as,
        y_down=reading.get("y_down"),
        calibration=reading.get("calibration"),
        overwrite=force,
    )
    with contextlib.closing(conversion.steps()) as steps:
        for place, _ in enumerate(steps):
            if not place % 32:
                await asyncio.sleep(0)  # where it can be cut off
    counts = conversion.counts
    if counts.unread:
        click.echo(
            f"smartcam: note: {counts.unread} of {counts.results} results could not be read: "
            "their messages say why",
            err=True,
        )
    _show_bag(output, counts, options)


def _loaded(path: str, since: datetime | None = None, until: datetime | None = None) -> Recording:
    """Return a recording; where it stops being readable stands on stderr."""
    from smartcam.recording import load_recording

    loaded = load_recording(Path(path), since=since, until=until)
    for remark in loaded.remark.splitlines():
        click.echo(f"smartcam: note: {path}: {remark}", err=True)
    return loaded
