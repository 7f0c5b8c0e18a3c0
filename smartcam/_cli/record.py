"""``smartcam record``, ``replay``, ``pcap``, ``bag``: record a camera, and use recordings."""

from __future__ import annotations

import asyncio
import contextlib
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, cast

import click

from smartcam._cli.options import (
    CONNECT_WARNING,
    OUTPUT_OPTIONS,
    SECONDS,
    Options,
    async_command,
    option,
)
from smartcam._cli.running import run_until_first
from smartcam._cli.terminal import counting_line
from smartcam._cli.texts import emulator_data, not_running_error
from smartcam._extras import from_part
from smartcam.backoff import Backoff
from smartcam.exceptions import (
    CameraFaultError,
    CommandRejectedError,
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
    from collections.abc import AsyncIterator, Coroutine

    from smartcam.camera import Camera
    from smartcam.fleet import FleetCamera
    from smartcam.frames import FrameSource
    from smartcam.observers import Observer
    from smartcam.recording import BagRecorder, FleetReplay, Recorder, Recording
    from smartcam.recording._inside import BagCounts, ResultPictures


def _parse_time(_ctx: click.Context, _param: click.Parameter, value: str | None) -> datetime | None:
    """Parse a time with its zone."""
    try:
        return None if value is None else datetime.fromisoformat(value).astimezone(UTC)
    except (ValueError, OverflowError) as exc:
        raise click.BadParameter(f"{value!r} is no time such as 2026-01-02T03:04:05Z") from exc


JUDGED_PICTURES: Final = "judged"
"""Value of --pictures: record the picture from which each result was made."""

NO_PICTURES: Final = "none"

_camera_option = click.option(
    "--camera", metavar="NAME", help="Camera of the recording; default all of them."
)


@click.command(
    help="Record into an MCAP file all that a camera sends, until Ctrl-C, --count or --seconds: "
    "frames, results, events, errors; for a fleet's camera the results of all programs' "
    "triggers, but no frames. --bag writes a rosbag2 for ROS 2, too, or instead. After a "
    "lost link the recording goes on. "
    f"{CONNECT_WARNING}"
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
    "--every", type=SECONDS, metavar="SECONDS", help="Seconds between two triggers to send."
)
@click.option(
    "--pictures",
    metavar="judged|none|SOURCE",
    help="judged: each result's own picture, for software cameras (the default) and a fleet's "
    "cameras with frames. none: no pictures. SOURCE: also the pictures of a source of "
    "frames, such as gige://HOST.",
)
@click.option(
    "--read-images",
    is_flag=True,
    help="With --every: read the camera's picture after each result, and record it.",
)
@option("--name", help="The camera's name in the file; default HOST:PORT.")
@option("--application")
@option("--interpret-as", help="Interpretation of results; default raw: bytes, kept as hex.")
@async_command("--y-down", "--count", "--seconds", "--timeout", *OUTPUT_OPTIONS, interrupt_code=0)
async def record(
    url: str,
    output: str | None,
    bag: str | None,
    force: bool,
    every: float | None,
    pictures: str | None,
    read_images: bool,
    options: Options,
) -> None:
    """Record a camera."""
    if (pictures not in {None, NO_PICTURES} or read_images) and output is None:
        raise click.UsageError("pictures go into a recording (-o), not into a bag")
    if output is not None and Path(output).suffix.lower() == ".mkv":
        raise click.UsageError(
            f"-o {output}: a video has no results: expected FILE.mcap; `smartcam frames record` "
            "writes videos"
        )
    if read_images and every is None:
        raise click.UsageError(
            "--read-images needs --every: it is only certain that the picture is the result's if "
            "the trigger was sent from here"
        )
    recorders = _make_recorders(output, bag, force=force, pictures=pictures != NO_PICTURES)
    url = await options.locate_url(url)
    async with contextlib.AsyncExitStack() as stack:
        source = result_pictures = None
        observers: list[Observer] = [*recorders]
        if pictures == JUDGED_PICTURES:
            result_pictures = _result_pictures(url, recorders[0])
            observers += [] if result_pictures is None else [result_pictures]
        elif pictures is not None and pictures != NO_PICTURES:
            with from_part("frames", "pictures need"):
                from smartcam._cli.frame_sources import make_source

            source = await stack.enter_async_context(make_source(pictures, options))
        camera = stack.enter_context(options.camera(url, observers=observers, reconnect=Backoff()))
        plan = _Plan(every, source, result_pictures, read_images)
        await _record(camera, recorders, plan, options)


class _Plan(NamedTuple):
    """The triggers that a recording sends, and the pictures that it records."""

    every: float | None  # seconds between triggers; None: none are sent
    source: FrameSource | None  # source whose pictures are recorded, too
    # finds the picture of each result among the camera's frames
    result_pictures: ResultPictures | None
    read_images: bool  # whether the camera's picture is read after each trigger


def _result_pictures(url: str, recorder: Recorder) -> ResultPictures | None:
    """Return the finder of results' pictures; None for a software camera, which sends them.

    Raises UnsupportedError: the pictures of the camera's results cannot be found.
    """
    from smartcam.settings import is_fleet, is_software, masked

    if is_software(url):
        return None
    if not is_fleet(url):
        raise UnsupportedError(
            f"--pictures judged: {masked(url)} sends no pictures with its results: expected a "
            "software camera, or a camera with frames of a fleet; --pictures SOURCE records those "
            "of a source of frames, and --read-images asks a camera that can send one"
        )
    with from_part("frames", "pictures need"):
        from smartcam.recording._inside import ResultPictures
    return ResultPictures(recorder)


def _make_recorders(
    output: str | None, bag: str | None, *, force: bool, pictures: bool
) -> list[Recorder]:
    """Return the recorders of the options: of a file, of a bag, or of both."""
    from smartcam.recording import Recorder

    recorders: list[Recorder] = []
    if output is not None:
        recorders.append(Recorder(output, overwrite=force, pictures=pictures))
    if bag is not None:
        if output is not None and Path(output).resolve().parent == Path(bag).resolve():
            raise ConfigurationError(f"--output {output}: it would be in the bag's own folder")
        with from_part("ros2", "a bag needs"):
            from smartcam.recording import BagRecorder
        recorders.append(BagRecorder(bag, overwrite=force))
    if not recorders:
        raise click.UsageError("Missing option '-o' / '--output', or '--bag'.")
    return recorders


async def _record(
    unopened_camera: Camera, recorders: list[Recorder], plan: _Plan, options: Options
) -> None:
    from smartcam.settings import is_fleet

    opened_recorders: list[Recorder] = []
    settings = {
        "interpret_as": options.interpret_as or unopened_camera.settings.interpret_as,
        "application": options.application,
        "y_down": options.y_down,
    }
    try:
        for recorder in recorders:
            recorder.open()
            opened_recorders.append(recorder)
        options.show_remarks(unopened_camera)
        _describe(
            recorders,
            unopened_camera.name,
            **{name: value for name, value in settings.items() if value},
        )
        # a container is interpreted only if there is a subscription
        results = unopened_camera.results(max_queue=1)
        async with unopened_camera as camera:
            if is_fleet(camera.url):
                _describe_fleet_camera(recorders, cast("FleetCamera[Any]", camera))
            elif plan.every is None and not camera.capabilities.unasked_results:
                raise UnsupportedError(
                    f"{camera.name}: the camera sends no results by itself; to have some triggered "
                    "while it is recorded: --every SECONDS"
                )
            if plan.read_images and not camera.capabilities.read_image:
                raise UnsupportedError(
                    f"{camera.name}: this camera cannot be asked for a picture; --pictures SOURCE "
                    "records those of a source of frames"
                )
            paths = {_file_kind(recorder): str(recorder.path) for recorder in recorders}
            options.show(
                {"url": camera.url, **paths},
                f"recording {camera.url} to {' and '.join(paths.values())}, Ctrl-C to end",
            )
            async with _judged_source(camera, plan) as source, counting_line(camera):
                jobs = _recording_jobs(camera, recorders, plan, results, options)
                if source is not None and plan.result_pictures is not None:
                    jobs.insert(0, plan.result_pictures.record(source, camera.name))
                await run_until_first(jobs, options.seconds)
    finally:
        await _close_all(opened_recorders, unopened_camera, options)


@contextlib.asynccontextmanager
async def _judged_source(camera: Camera, plan: _Plan) -> AsyncIterator[FrameSource | None]:
    """Yield the open source of the camera's frames, if pictures of results are to be found."""
    if plan.result_pictures is None:
        yield None
        return
    async with cast("FleetCamera[Any]", camera).frame_source() as source:
        yield source


def _recording_jobs(
    camera: Camera, recorders: list[Recorder], plan: _Plan, results: Any, options: Options
) -> list[Coroutine[Any, Any, None]]:
    """Return the jobs of a recording; it ends when the first of them ends."""
    from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT

    jobs: list[Coroutine[Any, Any, None]] = [*map(_watch_disk, recorders)]
    count = options.count
    image_recorder = recorders[0] if plan.read_images else None
    # with images, the triggers end it, so that the last picture is read, too
    result_count = count if image_recorder is None else None
    jobs.append(_wait_for_count(results, recorders[0], plan.result_pictures, result_count))
    if plan.every is not None:
        timeout = options.step_timeout(DEFAULT_TRIGGER_TIMEOUT)
        jobs.append(
            _send_triggers(camera, plan.every, timeout, image_recorder, count, plan.result_pictures)
        )
    if plan.source is not None:
        jobs.append(_record_pictures(plan.source, recorders[0], camera.name))
    return jobs


def _describe_fleet_camera(recorders: list[Recorder], camera: FleetCamera[Any]) -> None:
    """Record the agent's settings, which a recording without frames would not contain."""
    from smartcam._client._inside import camera_interpreter, has_pixel_positions

    dialect = camera.capabilities.dialect
    _describe(recorders, camera.name, dialect=dialect, endian=camera.endian)
    reading = {name: getattr(camera.settings, name) for name in ("y_down", "lenient")}
    if has_pixel_positions(camera_interpreter(camera, camera.active_application)):
        reading["pixels"] = True
    _describe(recorders, camera.name, **{name: value for name, value in reading.items() if value})


def _describe(recorders: list[Recorder], camera: str, **settings: object) -> None:
    for recorder in recorders:
        recorder.describe(camera, **settings)


def _file_kind(recorder: Recorder) -> str:
    return "file" if _as_bag(recorder) is None else "bag"


def _as_bag(recorder: Recorder) -> BagRecorder | None:
    """Return the recorder if it writes a bag; None if it writes a file."""
    from smartcam.recording import Recorder as PlainRecorder

    if type(recorder) is PlainRecorder:
        return None
    with from_part("ros2", "a bag needs"):
        from smartcam.recording import BagRecorder
    return recorder if isinstance(recorder, BagRecorder) else None


async def _watch_disk(recorder: Recorder) -> None:
    raise await recorder.wait_failed()


async def _wait_for_count(
    results: Any, recorder: Recorder, result_pictures: ResultPictures | None, count: int | None
) -> None:
    """Wait until ``count`` results and their pictures are recorded, or the camera is closed."""
    while count is None or recorder.counts.results < count:
        try:
            await anext(results)
        except InterpretationError:
            pass  # it is recorded as an error
        except StopAsyncIteration:
            return
    if result_pictures is not None:
        await result_pictures.wait_settled()


async def _record_pictures(source: FrameSource, recorder: Recorder, camera: str) -> None:
    """Record a source's pictures under the camera's name, until the source ends."""
    await recorder.record(source, camera=camera)


async def _record_image(camera: Camera, recorder: Recorder, result: Any, results: int) -> None:
    """Read and record a result's picture, unless a newer result has arrived meanwhile.

    ``results``: number of results that were recorded before.
    """
    try:
        image = await camera.read_image()
    except CommandRejectedError:  # the camera has no picture; the recorded frames show that
        return
    if recorder.counts.results == results:
        await asyncio.to_thread(recorder.add_image, camera.name, image, result=result)


async def _send_triggers(
    camera: Camera,
    every: float,
    timeout: float,
    image_recorder: Recorder | None,
    count: int | None,
    result_pictures: ResultPictures | None,
) -> None:
    """Send a trigger every ``every`` seconds; ignore failed ones, if the camera runs at first.

    ``image_recorder``: recorder for the picture of each of ``count`` results, None for no pictures.
    ``result_pictures``: finds each result's picture; the first trigger waits until frames arrive.
    """
    if result_pictures is not None:
        await result_pictures.wait_streaming()
    loop = asyncio.get_running_loop()
    next_at, has_succeeded = loop.time(), False
    while True:
        try:
            result = await camera.trigger(timeout=timeout)
            has_succeeded = True
            if image_recorder is not None:
                await _record_image(camera, image_recorder, result, image_recorder.counts.results)
                if count is not None and image_recorder.counts.results >= count:
                    return
        except NotRunningError as exc:
            if not has_succeeded:
                raise not_running_error(exc, camera, "record") from exc
        except (TriggerError, CameraFaultError, InterpretationError, ResponseTimeoutError):
            pass
        except (ConnectionTakenError, ConnectionClosedError):
            raise
        except ConnectionLostError:
            with contextlib.suppress(ResponseTimeoutError):
                await camera.wait_connected()
        # a trigger that took too long skips the next ones, instead of hurrying
        next_at += every * max(1, -(-(loop.time() - next_at) // every))
        await asyncio.sleep(next_at - loop.time())


async def _close_all(recorders: list[Recorder], camera: Camera, options: Options) -> None:
    """Close each recorder and report it, even if this fails for another one."""
    async with contextlib.AsyncExitStack() as stack:
        for recorder in reversed(recorders):
            stack.push_async_callback(_close_and_report, recorder, camera, options)


async def _close_and_report(recorder: Recorder, camera: Camera, options: Options) -> None:
    """Close a recorder and report its contents; remove the file if there was no session."""
    path = recorder.path
    await asyncio.to_thread(recorder.close)
    bag = _as_bag(recorder)
    if bag is not None:
        if camera.statistics().sessions:
            _show_bag(path, bag.bag_counts, options)
        else:
            bag.remove()
    elif camera.statistics().sessions:
        counts, size = recorder.counts._asdict(), path.stat().st_size
        always_shown = ("frames", "results", "events", "errors")
        text = ", ".join(
            f"{kind.replace('_', ' ')} {number}"
            for kind, number in counts.items()
            if number or kind in always_shown
        )
        options.show({"file": str(path), **counts, "bytes": size}, f"{path}: {text}; {size} bytes")
    elif path.is_file() and not path.is_symlink():
        path.unlink()


def _show_bag(path: str | Path, counts: BagCounts, options: Options) -> None:
    values = counts._asdict()
    text = ", ".join(f"{kind} {number}" for kind, number in values.items())
    options.show({"bag": str(path), **values}, f"{path}: {text}")


@click.command(
    help="Emulate the recorded cameras: each trigger gets the recorded containers, byte for byte "
    "and after the same time, and unasked messages come again. Prints one line per camera, "
    "its URL. After the end of a recording triggers get no result, unless --loop. A folder "
    "that an agent recorded (record: in its fleet file) is played as a fleet: its cameras "
    "under their names, through an agent, with their fleet URLs; --port is the agent's then. "
    "A TIME is 2026-01-02T03:04:05, by the local clock unless it ends in Z or +01:00."
)
@click.argument("recording", metavar="RUN.mcap|FOLDER", type=click.Path())
@click.option("--speed", type=float, default=1.0, show_default=True, help="How many times faster.")
@click.option("--loop", is_flag=True, help="Begin again at the end of the recording.")
@click.option(
    "--from",
    "start",
    metavar="TIME",
    callback=_parse_time,
    help="Begin at this time of the recording.",
)
@click.option(
    "--until", metavar="TIME", callback=_parse_time, help="End at this time of the recording."
)
@_camera_option
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=0,
    show_default=True,
    help="Port; 0 takes a free one. Further cameras take the next ones.",
)
@click.option(
    "--transport", type=click.Choice(("tcp", "udp")), help="Transport; default the recorded one."
)
@async_command(*OUTPUT_OPTIONS, interrupt_code=0, terminate_code=0)
async def replay(
    recording: str,
    speed: float,
    loop: bool,
    camera: str | None,
    host: str,
    port: int,
    transport: Literal["tcp", "udp"] | None,
    start: datetime | None,
    until: datetime | None,
    options: Options,
) -> None:
    """Play a recording."""
    from smartcam.recording import replay as replay_camera

    loaded = _load(recording, start, until)
    if loaded.files != (loaded.path,):
        if transport is not None:
            raise click.UsageError("--transport is only for a file: an agent plays a folder")
        cameras = None if camera is None else [camera]
        bracketed_host = f"[{host}]" if ":" in host else host
        with from_part("fleet", "a folder of a fleet's recordings needs"):
            from smartcam.recording import FleetReplay
        fleet_replay = FleetReplay(
            loaded,
            cameras=cameras,
            speed=speed,
            loop=loop,
            listen=f"tcp/{bracketed_host}:{port}",
            on_over=_report_camera_end,
        )
        await _play_fleet(fleet_replay, options)
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
                on_over=_report_end,
                **({} if transport is None else {"transport": transport}),
            )
            await stack.enter_async_context(emulator)
            options.show({**emulator_data(emulator), "camera": emulator.name}, emulator.url)
        await asyncio.Event().wait()


async def _play_fleet(fleet_replay: FleetReplay, options: Options) -> None:
    """Play the recordings of a fleet until cancelled."""
    with from_part("fleet", "a folder of a fleet's recordings needs"):
        from smartcam._cli.serve import share

    for name, reason in fleet_replay.skipped.items():
        click.echo(f"smartcam: note: {name} is not played: {reason}", err=True)
    async with fleet_replay:
        await share(fleet_replay.server, options)


def _report_camera_end(name: str) -> None:
    click.echo(f"smartcam: note: {name}: the end of its recording is reached", err=True)


def _report_end() -> None:
    click.echo("smartcam: note: the recording is over: triggers get no result any more", err=True)


@click.command(
    help="Write a recording's frames as packets for Wireshark: Ethernet, IP, TCP or UDP, with the "
    "recorded times. The client's address and the division into packets are made up."
)
@click.argument("recording", metavar="RUN.mcap", type=click.Path())
@option("--output", required=True)
@option("--force")
@_camera_option
@async_command(*OUTPUT_OPTIONS)
async def pcap(
    recording: str, output: str, force: bool, camera: str | None, options: Options
) -> None:
    """Convert a recording for Wireshark."""
    from smartcam.recording import write_pcap

    count = write_pcap(_load(recording), output, camera=camera, overwrite=force)
    options.show({"file": output, "packets": count}, f"{output}: {count} packets")


@click.command(
    help="Make a rosbag2 of a recording: an MCAP file with ROS 2 messages in a folder, in the "
    "recorded order and with the recorded times. Values are as recorded; --interpret-as or "
    "--calibration interprets each result's bytes again, and keeps the errors."
)
@click.argument("recording", metavar="RUN.mcap", type=click.Path())
@click.option(
    "-o", "--output", metavar="FOLDER", type=click.Path(), required=True, help="The bag's folder."
)
@option("--force", help="Replace an existing bag.")
@_camera_option
@option("--interpret-as", help="New interpretation of the results; default as recorded.")
@async_command("--y-down", "--calibration", *OUTPUT_OPTIONS)
async def bag(
    recording: str, output: str, force: bool, camera: str | None, options: Options
) -> None:
    """Convert a recording for ROS 2."""
    with from_part("ros2", "a bag needs"):
        from smartcam.recording._inside import BagConversion

    loaded = _load(recording)
    reading = options.interpret_options(fleet=True) if options.calibration or options.y_down else {}
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
        for number, _ in enumerate(steps):
            if not number % 32:
                await asyncio.sleep(0)  # here the task can be cancelled
    counts = conversion.counts
    if counts.uninterpreted:
        click.echo(
            f"smartcam: note: {counts.uninterpreted} of {counts.results} results could not be "
            "read: their messages say why",
            err=True,
        )
    _show_bag(output, counts, options)


def _load(path: str, start: datetime | None = None, until: datetime | None = None) -> Recording:
    """Load a recording; print remarks on damaged parts to stderr."""
    from smartcam.recording import load_recording

    loaded = load_recording(Path(path), since=start, until=until)
    for remark in loaded.remark.splitlines():
        click.echo(f"smartcam: note: {path}: {remark}", err=True)
    return loaded
