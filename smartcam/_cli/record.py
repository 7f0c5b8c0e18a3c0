"""``smartcam record``, ``replay``, ``pcap``, ``bag``: record a camera, and use recordings."""

from __future__ import annotations

import asyncio
import contextlib
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, cast

import click

from smartcam._cli.options import CONNECTS, OUTPUT, SECONDS, Options, option, runs
from smartcam._cli.running import first
from smartcam._cli.terminal import counting
from smartcam._cli.texts import camera_value, not_running
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
    from smartcam.recording._inside import BagCounts, JudgedPictures


def _time(_ctx: click.Context, _param: click.Parameter, value: str | None) -> datetime | None:
    """Parse a time with its zone."""
    try:
        return None if value is None else datetime.fromisoformat(value).astimezone(UTC)
    except (ValueError, OverflowError) as exc:
        raise click.BadParameter(f"{value!r} is no time such as 2026-01-02T03:04:05Z") from exc


JUDGED: Final = "judged"
"""Value of --pictures for the pictures that results were made of."""

NO_PICTURES: Final = "none"

_camera = click.option(
    "--camera", metavar="NAME", help="Camera of the recording; default all of them."
)


@click.command(
    help="Record everything a camera says to an MCAP file, until Ctrl-C, --count or --seconds: "
    "frames, results, events, errors; of a fleet's camera no frames, and the results of "
    "every program's triggers. --bag writes a rosbag2 for ROS 2, too, or instead. After a "
    "lost link the recording goes on. "
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
@runs("--y-down", "--count", "--seconds", "--timeout", *OUTPUT, interrupted=0)
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
            "--read-images needs --every: only of a trigger that is sent from "
            "here the picture that is read is surely the result's"
        )
    recorders = _recorders(output, bag, force=force, pictures=pictures != NO_PICTURES)
    url = await options.located(url)
    async with contextlib.AsyncExitStack() as stack:
        source = judged = None
        observers: list[Observer] = [*recorders]
        if pictures == JUDGED:
            judged = _judged_pictures(url, recorders[0])
            observers += [] if judged is None else [judged]
        elif pictures is not None and pictures != NO_PICTURES:
            with from_part("frames", "pictures need"):
                from smartcam._cli.frame_sources import opened

            source = await stack.enter_async_context(opened(pictures, options))
        camera = stack.enter_context(options.camera(url, observers=observers, reconnect=Backoff()))
        await _record(camera, recorders, _Plan(every, source, judged, read_images), options)


class _Plan(NamedTuple):
    """The triggers and pictures of a recording."""

    every: float | None  # seconds between triggers; None: none are sent
    source: FrameSource | None  # source whose pictures are recorded, too
    judged: JudgedPictures | None  # finds each result's picture among the camera's frames
    read_images: bool  # whether the camera's picture is read after each trigger


def _judged_pictures(url: str, recorder: Recorder) -> JudgedPictures | None:
    """Return the finder of each result's picture; None if the camera itself names the picture.

    Raises UnsupportedError: the pictures of the camera's results cannot be found.
    """
    from smartcam.settings import is_fleet, is_software, masked

    if is_software(url):
        return None
    if not is_fleet(url):
        raise UnsupportedError(
            f"--pictures judged: {masked(url)} sends no pictures with its results: expected a "
            "software camera, or a camera with frames of a fleet; --pictures SOURCE records those "
            "of a source of frames, and --read-images asks a camera that has any"
        )
    with from_part("frames", "pictures need"):
        from smartcam.recording._inside import JudgedPictures
    return JudgedPictures(recorder)


def _recorders(
    output: str | None, bag: str | None, *, force: bool, pictures: bool
) -> list[Recorder]:
    """Return the recorders of the file and of the bag that the options ask for."""
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
    unopened: Camera, recorders: list[Recorder], plan: _Plan, options: Options
) -> None:
    from smartcam.settings import is_fleet

    opened: list[Recorder] = []
    facts = {
        "interpret_as": options.interpret_as or unopened.settings.interpret_as,
        "application": options.application,
        "y_down": options.y_down,
    }
    try:
        for recorder in recorders:
            recorder.open()
            opened.append(recorder)
        options.remark(unopened)
        _describe(recorders, unopened.name, **{name: fact for name, fact in facts.items() if fact})
        # subscribed, so that every container is interpreted
        results = unopened.results(max_queue=1)
        async with unopened as camera:
            if is_fleet(camera.url):
                _describe_shared(recorders, cast("FleetCamera[Any]", camera))
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
            paths = {_word(recorder): str(recorder.path) for recorder in recorders}
            options.show(
                {"url": camera.url, **paths},
                f"recording {camera.url} to {' and '.join(paths.values())}, Ctrl-C to end",
            )
            async with _judged_source(camera, plan) as source, counting(camera):
                jobs = _jobs(camera, recorders, plan, results, options)
                if source is not None and plan.judged is not None:
                    jobs.insert(0, plan.judged.record(source, camera.name))
                await first(jobs, options.seconds)
    finally:
        await _end_all(opened, unopened, options)


@contextlib.asynccontextmanager
async def _judged_source(camera: Camera, plan: _Plan) -> AsyncIterator[FrameSource | None]:
    """Yield the open source of the frames among which results' pictures are searched."""
    if plan.judged is None:
        yield None
        return
    async with cast("FleetCamera[Any]", camera).frame_source() as source:
        yield source


def _jobs(
    camera: Camera, recorders: list[Recorder], plan: _Plan, results: Any, options: Options
) -> list[Coroutine[Any, Any, None]]:
    """Return the jobs of a recording, which ends with the first of them."""
    from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT

    jobs: list[Coroutine[Any, Any, None]] = [*map(_watch_disk, recorders)]
    count = options.count
    images = recorders[0] if plan.read_images else None  # so that the last picture is read, too
    jobs.append(_count(results, recorders[0], plan.judged, count if images is None else None))
    if plan.every is not None:
        step = options.step(DEFAULT_TRIGGER_TIMEOUT)
        jobs.append(_trigger(camera, plan.every, step, images, count, plan.judged))
    if plan.source is not None:
        jobs.append(_record_pictures(plan.source, recorders[0], camera.name))
    return jobs


def _describe_shared(recorders: list[Recorder], camera: FleetCamera[Any]) -> None:
    """Record the agent's facts that a recording of frames would contain."""
    from smartcam._client._inside import in_pixels, own_interpreter

    dialect = camera.capabilities.dialect
    _describe(recorders, camera.name, dialect=dialect, endian=camera.endian)
    read = {name: getattr(camera.settings, name) for name in ("y_down", "lenient")}
    if in_pixels(own_interpreter(camera, camera.active_application)):
        read["pixels"] = True
    _describe(recorders, camera.name, **{name: on for name, on in read.items() if on})


def _describe(recorders: list[Recorder], camera: str, **facts: object) -> None:
    for recorder in recorders:
        recorder.describe(camera, **facts)


def _word(recorder: Recorder) -> str:
    return "file" if _as_bag(recorder) is None else "bag"


def _as_bag(recorder: Recorder) -> BagRecorder | None:
    """Return a recorder that writes a bag; None for one that writes a plain file."""
    from smartcam.recording import Recorder as PlainRecorder

    if type(recorder) is PlainRecorder:
        return None
    with from_part("ros2", "a bag needs"):
        from smartcam.recording import BagRecorder
    return recorder if isinstance(recorder, BagRecorder) else None


async def _watch_disk(recorder: Recorder) -> None:
    raise await recorder.wait_failed()


async def _count(
    results: Any, recorder: Recorder, judged: JudgedPictures | None, count: int | None
) -> None:
    """Return after so many results, with their pictures; or at the camera's end."""
    while count is None or recorder.counts.results < count:
        try:
            await anext(results)
        except InterpretationError:
            pass  # the loss is recorded as an error
        except StopAsyncIteration:
            return
    if judged is not None:
        await judged.wait_settled()


async def _record_pictures(source: FrameSource, recorder: Recorder, camera: str) -> None:
    """Record a source's pictures as the camera's; the end of the source ends the recording."""
    await recorder.record(source, camera=camera)


async def _read_image(camera: Camera, recorder: Recorder, result: Any, results: int) -> None:
    """Record a result's picture, before another trigger replaces the picture."""
    try:
        image = await camera.read_image()
    except CommandRejectedError:  # the camera has none, as the recorded frames show
        return
    if recorder.counts.results == results:
        await asyncio.to_thread(recorder.add_image, camera.name, image, result=result)


async def _trigger(
    camera: Camera,
    every: float,
    timeout: float,
    images: Recorder | None,
    count: int | None,
    judged: JudgedPictures | None,
) -> None:
    """Send triggers; errors are recorded, once the first triggers have succeeded.

    ``images``: the recorder that also gets the picture of each of ``count`` results.
    ``judged``: finder of each result's picture; triggers wait until there are pictures.
    """
    if judged is not None:
        await judged.wait_streaming()
    loop = asyncio.get_running_loop()
    when, worked = loop.time(), False
    while True:
        try:
            result = await camera.trigger(timeout=timeout)
            worked = True
            if images is not None:
                await _read_image(camera, images, result, images.counts.results)
                if count is not None and images.counts.results >= count:
                    return
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
        # a trigger that took too long skips the next ones, instead of hurrying
        when += every * max(1, -(-(loop.time() - when) // every))
        await asyncio.sleep(when - loop.time())


async def _end_all(recorders: list[Recorder], camera: Camera, options: Options) -> None:
    """End each file, even if ending another has failed."""
    async with contextlib.AsyncExitStack() as stack:
        for recorder in reversed(recorders):
            stack.push_async_callback(_end, recorder, camera, options)


async def _end(recorder: Recorder, camera: Camera, options: Options) -> None:
    """End the file, and report its contents; without a session there is no file."""
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
        always = ("frames", "results", "events", "errors")
        text = ", ".join(
            f"{kind.replace('_', ' ')} {number}"
            for kind, number in counts.items()
            if number or kind in always
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
    "--from", "since", metavar="TIME", callback=_time, help="Begin at this time of the recording."
)
@click.option("--until", metavar="TIME", callback=_time, help="End at this time of the recording.")
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
    "--transport", type=click.Choice(("tcp", "udp")), help="Transport; default the recorded one."
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
    from smartcam.recording import replay as replay_camera

    loaded = _loaded(recording, since, until)
    if loaded.files != (loaded.path,):
        if transport is not None:
            raise click.UsageError("--transport is for a file: programs come to a folder's agent")
        cameras = None if camera is None else [camera]
        place = f"[{host}]" if ":" in host else host
        with from_part("fleet", "a folder of a fleet's recordings needs"):
            from smartcam.recording import FleetReplay
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
    """Play a folder until cancelled."""
    with from_part("fleet", "a folder of a fleet's recordings needs"):
        from smartcam._cli.serve import share

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
    """Convert a recording for Wireshark."""
    from smartcam.recording import write_pcap

    count = write_pcap(_loaded(recording), output, camera=camera, overwrite=force)
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
@_camera
@option("--interpret-as", help="New interpretation of the results; default as recorded.")
@runs("--y-down", "--calibration", *OUTPUT)
async def bag(
    recording: str, output: str, force: bool, camera: str | None, options: Options
) -> None:
    """Convert a recording for ROS 2."""
    with from_part("ros2", "a bag needs"):
        from smartcam.recording._inside import BagConversion

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
                await asyncio.sleep(0)  # a place at which the task can be cancelled
    counts = conversion.counts
    if counts.unread:
        click.echo(
            f"smartcam: note: {counts.unread} of {counts.results} results could not be read: "
            "their messages say why",
            err=True,
        )
    _show_bag(output, counts, options)


def _loaded(path: str, since: datetime | None = None, until: datetime | None = None) -> Recording:
    """Return a recording; report on stderr where it stops being readable."""
    from smartcam.recording import load_recording

    loaded = load_recording(Path(path), since=since, until=until)
    for remark in loaded.remark.splitlines():
        click.echo(f"smartcam: note: {path}: {remark}", err=True)
    return loaded
