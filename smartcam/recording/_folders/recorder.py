"""Record the cameras of an agent (the process that shares a fleet) into a folder."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._arguments import check_callable, check_kind
from smartcam._client._inside import Interpretation
from smartcam._extras import from_part
from smartcam._server import Server
from smartcam.exceptions import ConfigurationError, RecordingError, SmartCamError
from smartcam.models import CameraEvent, Result, StatusChanged
from smartcam.observers import Observer
from smartcam.protocols.messages import ResultContainer
from smartcam.recording._folder import RecordingFolder
from smartcam.recording._folders.files import Limits
from smartcam.recording._folders.writer import FolderWriter
from smartcam.recording._mcap.form import RecordedError, load_compress

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from pathlib import Path

    from smartcam.fleet import FleetServer
    from smartcam.fleet._inside import RecordSection
    from smartcam.frames import Frame
    from smartcam.observers import RawFrame
    from smartcam.recording._folders.camera_recording import CameraRecording, RecordingCounts
    from smartcam.recording._folders.pictures import FleetPictures
    from smartcam.recording._mcap.form import Item


class _ResultWithEndian(NamedTuple):
    """A result of an agent, with its byte order."""

    result: Result[Any]  # result, whose value is its container
    endian: int | None  # byte order; None if it is not known


class FleetRecorder(Server):
    """Records the cameras of an agent into a folder, like ``record:`` in a fleet file.

    ::

        server = smartcam.fleet.serve("fleet.yaml")
        async with FleetRecorder(server), server:
            ...

    Start the recorder before the server, and stop it after the server. The disk never delays the
    agent: if the disk is full, missing or too slow, records are left out and counted in
    :attr:`counts` and in the files, and the disk is tried again until it works.

    Args:
        server: server whose cameras are recorded; not started yet.
        section: settings of the recording; default: ``record`` in the server's fleet file.
        on_trouble: function that is called in the event loop with the error when nothing can be
            written, and with None when it can again.

    Attributes:
        path: the folder.

    Raises:
        ConfigurationError: ``section`` is not given, and the fleet file has no ``record``.
    """

    def __init__(
        self,
        server: FleetServer,
        section: RecordSection | None = None,
        *,
        on_trouble: Callable[[RecordingError | None], None] = lambda _: None,
        _clock: Callable[[], float] = time.monotonic,
    ) -> None:
        # a program with an agent has already imported the agent's libraries
        from smartcam.fleet import FleetServer
        from smartcam.fleet._inside import RecordSection

        check_kind(server, FleetServer, "server", "a FleetServer", "recorder")
        check_callable(on_trouble, "on_trouble", "recorder")
        if section is None:
            section = server.file.record
        else:
            check_kind(section, RecordSection, "section", "a RecordSection, or None", "recorder")
        if section is None:
            raise ConfigurationError(f"fleet {server.file.fleet}: record: is not in its file")
        self.section: RecordSection = section
        self.path: Path = section.path(server.folder)
        self._server, self._on_trouble, self._clock = server, on_trouble, _clock
        self._writer: FolderWriter | None = None
        self._observer: Observer | None = None
        self._pictures: FleetPictures | None = None
        self._loop: asyncio.AbstractEventLoop | None = None

    async def start(self) -> None:
        """Start the thread that writes the folder.

        A folder that cannot be created or written is no error: the recorder tries again.

        Raises:
            ConfigurationError: another recorder writes the folder, or the server was started.
            MissingExtraError: the mcap library is not installed.

        Cancellation: leaves it stopped.
        """
        if self._observer is not None:
            return
        if self._server.shared_cameras:
            raise ConfigurationError(
                f"recordings {self.path}: start the recorder before the server"
            )
        section = self.section
        writer = FolderWriter(
            RecordingFolder(self.path),
            Limits(section.size, section.age, section.keep),
            load_compress(),
            self._report,
            self._clock,
        )
        self._loop, self._writer = asyncio.get_running_loop(), writer
        try:
            await _run_to_end(writer.start)
        except BaseException:
            self._writer = None
            await _run_to_end(writer.stop)
            raise
        observer_class = _SessionAndFrameObserver if section.messages else _SessionObserver
        self._pictures = self._new_pictures(writer)
        self._observer = observer_class(self._server, section, writer, self._pictures)
        self._server.observers.append(self._observer)

    def _new_pictures(self, writer: FolderWriter) -> FleetPictures | None:
        if self.section.pictures == "none":
            return None
        with from_part("frames", "pictures need"):
            from smartcam.recording._folders.pictures import FleetPictures

        return FleetPictures(self._server, writer, records_all=self.section.pictures == "all")

    async def stop(self) -> None:
        """Write waiting records and end the files, which takes some milliseconds, at most 30 s.

        Cancellation: the thread still finishes.
        """
        writer, observer, pictures = self._writer, self._observer, self._pictures
        self._observer = self._pictures = None
        if observer is not None:
            self._server.observers.remove(observer)
        try:
            if pictures is not None:
                await pictures.stop()
        finally:
            if writer is not None:
                await _run_to_end(writer.stop)

    @property
    def counts(self) -> dict[str, RecordingCounts]:
        """Counts of each camera's records, by the camera's name."""
        return {} if self._writer is None else self._writer.counts

    @property
    def trouble(self) -> RecordingError | None:
        """Error because of which nothing is written now; None without one."""
        return None if self._writer is None else self._writer.trouble

    def _report(self, trouble: RecordingError | None) -> None:
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                self._loop.call_soon_threadsafe(self._on_trouble, trouble)


async def _run_to_end(work: Callable[[], None]) -> None:
    """Run work in a thread, to its end even if the caller is cancelled."""
    running = asyncio.ensure_future(asyncio.to_thread(work))
    try:
        await asyncio.shield(running)
    except asyncio.CancelledError:
        await asyncio.wait({running})
        raise


class _SessionObserver(Observer):
    """Passes frames, results, events and errors of an agent's sessions to the writer."""

    def __init__(
        self,
        server: FleetServer,
        section: RecordSection,
        writer: FolderWriter,
        pictures: FleetPictures | None,
    ) -> None:
        self._server, self._section, self._writer = server, section, writer
        self._pictures = pictures
        # recording of each camera; None for a camera that is not recorded
        self._recordings: dict[str, CameraRecording | None] = {}

    def on_state(self, event: CameraEvent) -> None:
        """Pass on an event."""
        recording = self._recording_of(event.camera)
        if recording is not None:
            if isinstance(event, StatusChanged):
                recording.endian = self._endian(event.camera) or 0
            self._writer.put(recording, event, 0, event=True)
            if self._pictures is not None:
                self._pictures.start_recording(recording)

    def on_results(self, results: Sequence[Result]) -> None:
        """Pass on results that came together."""
        camera = results[0].camera
        recording = self._recording_of(camera)
        if recording is None:
            return
        endian = self._endian(camera)
        for result in results:
            self._writer.put(recording, _ResultWithEndian(result, endian), 4 * len(result.raw))
            if self._pictures is not None:
                self._pictures.add_result(recording, result)

    def on_picture(self, result: Result, frame: Frame) -> None:
        """Pass on the picture of a software camera's result."""
        recording = self._recording_of(result.camera)
        if recording is not None and self._pictures is not None:
            self._pictures.add_reported(recording, result, frame)

    def on_error(self, camera: str, error: SmartCamError, triggered_at: datetime | None) -> None:
        """Pass on an error."""
        recording = self._recording_of(camera)
        if recording is not None:
            text = str(error)
            error_name = type(error).__name__
            recorded = RecordedError(camera, datetime.now(UTC), error_name, text, triggered_at)
            self._writer.put(recording, recorded, len(text))

    def _endian(self, camera: str) -> int | None:
        shared = self._server.shared_cameras.get(camera)
        return None if shared is None else shared.client.endian

    def _recording_of(self, camera: str) -> CameraRecording | None:
        if camera not in self._recordings and camera in self._server.shared_cameras:
            self._recordings[camera] = self._new_recording(camera)
        return self._recordings.get(camera)

    def _new_recording(self, camera: str) -> CameraRecording | None:
        if not self._section.chooses(camera):
            return None
        settings = self._server.shared_cameras[camera].settings
        spec, y_down, lenient = settings.interpret_as, settings.y_down, settings.lenient
        maker = _ItemMaker(camera, spec, y_down, lenient)
        recording = self._writer.new_recording(camera, maker.items)
        given = {
            "fleet": self._server.file.fleet,
            "interpret_as": spec,
            "application": settings.application,
            "y_down": y_down or None,
            "lenient": lenient or None,
            "frames": None if self._section.messages else "no",
        }
        metadata = {name: str(value) for name, value in given.items() if value is not None}
        self._writer.describe(recording, metadata)
        return recording


class _SessionAndFrameObserver(_SessionObserver):
    """Passes the frames of the protocol on, too."""

    def on_raw_frame(self, frame: RawFrame) -> None:
        """Pass on a frame; the writer's thread decodes it."""
        recording = self._recording_of(frame.camera)
        if recording is not None:
            self._writer.put(recording, frame, 2 * frame.size)


class _ItemMaker:
    """Makes items of a camera's entries in the writer's thread, where it interprets results.

    Args:
        camera: name of the camera.
        spec: interpreter of the results; None: results are not interpreted.
        y_down: ``y_down`` of the camera's settings.
        lenient: ``lenient`` of the camera's settings.
    """

    def __init__(self, camera: str, spec: Any, y_down: bool, lenient: bool) -> None:
        self._camera = camera
        self._interpret: Interpretation | None = None
        if spec is not None:
            self._interpret = Interpretation(spec, lenient=lenient, y_down=y_down)

    def items(self, entry: Any) -> Iterator[Item]:
        """Yield the items of an entry."""
        if not isinstance(entry, _ResultWithEndian):
            yield entry
            return
        result = entry.result._replace(value=None)
        if self._interpret is None or entry.endian is None:
            yield result
            return
        try:
            yield self._interpreted(entry.result, entry.endian, self._interpret)
        except SmartCamError as exc:
            yield result
            at = datetime.now(UTC)
            error_name = type(exc).__name__
            yield RecordedError(self._camera, at, error_name, str(exc), result.triggered_at)

    def _interpreted(
        self, result: Result[Any], endian: int, interpret: Interpretation
    ) -> Result[Any]:
        cells = fault = None
        if result.value.cells:
            content: dict[str, Any] = json.loads(result.value.cells)
            fault, texts = content.get("fault"), content.get("cells")
            cells = None if texts is None else tuple(texts)
        container = ResultContainer(
            application=result.application, data=result.raw, cells=cells, fault=fault
        )
        at = result.received_at
        value, sequence, _ = interpret(
            container, endian, camera=self._camera, number=result.number, at=at
        )
        return result._replace(value=value, sequence=sequence)
