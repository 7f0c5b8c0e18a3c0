"""Read a recording, complete or cut off."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar, overload

from smartcam._arguments import check_aware_datetime, check_kind, check_path, check_text
from smartcam._extras import from_part
from smartcam.exceptions import (
    ConfigurationError,
    MissingExtraError,
    RecordingError,
    SmartCamError,
)
from smartcam.models import CameraEvent, Result
from smartcam.observers import TraceEntry
from smartcam.recording._folder import SUFFIX, FileName, files_of
from smartcam.recording._mcap.bodies import LastBodies
from smartcam.recording._mcap.form import (
    ANNOTATIONS_SCHEMA,
    CAMERA_METADATA,
    EPOCH,
    FILE_METADATA,
    FORMATS,
    KINDS,
    MAX_CAMERAS,
    PICTURE_SCHEMAS,
    RecordedError,
    RecordedPicture,
    camera_name,
    count_values,
    message_fields,
    optional_field,
)
from smartcam.recording._mcap.json import data_of
from smartcam.recording._mcap.records import (
    Channel,
    CutOffError,
    McapMessage,
    Metadata,
    RecordReader,
    Schema,
)
from smartcam.recording._picture_matching import match_pictures
from smartcam.recording._recorder import Counts
from smartcam.recording._state import STATE_METADATA, RecordedState

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sized
    from datetime import datetime

    from smartcam.frames import Frame
    from smartcam.frames._inside import Drawing
    from smartcam.recording._mcap.form import Item, MessageKind
    from smartcam.recording._mcap.records import Record
    from smartcam.recording._picture_matching import ResultWithPicture

VALUE_ALLOWANCE = 10_000_000
"""Number of values that the messages of a small file may have; to read them takes ten seconds."""

VALUES_PER_BYTE = 100
"""Number of values that a larger file may have for each of its bytes. Real recordings have less
than one, since each message takes 16 bytes of index; tables of mostly zeros have ten."""

MIN_POINT_BYTES = 2
"""Least number of bytes of a mark's point in a message."""

T = TypeVar("T")


class RecordedCamera(NamedTuple):
    """The recorded metadata of a camera.

    Attributes:
        name: name of the camera.
        url: address of the camera, without a password; "" if there was never a session.
        protocol: name of the protocol; "" if there was never a session.
        dialect: name of the dialect; None if it is not known.
        quirks: deviations from the dialect.
        interpret_as: interpreter of the results, as text; None if it was not recorded.
        metadata: all recorded texts, by their names.
    """

    name: str
    url: str
    protocol: str
    dialect: str | None
    quirks: tuple[str, ...]
    interpret_as: str | None
    metadata: dict[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """An MCAP file of :class:`~smartcam.recording.Recorder`; made by :func:`load_recording`.

    It may also be a folder of :class:`~smartcam.recording.FleetRecorder`. Each call reads the items
    from the file again, in the order of recording; in a folder, camera by camera.

    Attributes:
        path: the file, or the folder.
        version: version of the smartcam that wrote the recording.
        cameras: the cameras in it, by name, in the order in which they appear.
        counts: numbers of items of each kind.
        began: time of the first item, UTC; None if there is none.
        ended: time of the last item, UTC.
        remark: "" for a whole file; otherwise the position after which the file cannot be read, and
            the reason. For a folder: the remarks on its files, one per line.
        files: the file itself; for a folder its files, camera by camera, each camera's in order.
        since: time before which items are left out, UTC; None without one.
        until: time after which items are left out, UTC; None without one.
    """

    path: Path
    version: str
    cameras: dict[str, RecordedCamera]
    counts: Counts
    began: datetime | None
    ended: datetime | None
    remark: str
    files: tuple[Path, ...]
    since: datetime | None = None
    until: datetime | None = None

    @property
    def seconds(self) -> float:
        """Seconds from the first to the last item."""
        if self.began is None or self.ended is None:
            return 0.0
        return (self.ended - self.began).total_seconds()

    def camera(self, name: str | None = None) -> RecordedCamera:
        """Return the camera with a name; without a name the only one.

        Raises:
            ConfigurationError: there is no such camera, or there are several; the text names them.
        """
        if name is not None:
            name = check_text(name, "camera", f"recording {self.path}")
        names = ", ".join(self.cameras)
        if not names:
            raise ConfigurationError(f"recording {self.path}: it has no camera")
        if name is not None and name not in self.cameras:
            raise ConfigurationError(
                f"recording {self.path}: it has no camera {name!r}; it has: {names}"
            )
        if name is None and len(self.cameras) != 1:
            raise ConfigurationError(
                f"recording {self.path}: it has {len(self.cameras)} cameras, choose one: {names}"
            )
        return self.cameras[next(iter(self.cameras)) if name is None else name]

    def items(self, camera: str | None = None) -> Iterator[Item]:
        """Yield all items, of all cameras or of one."""
        for item in self.all_items(camera):
            if not isinstance(item, RecordedState) and (
                self.since is None or _time_of(item) >= self.since
            ):
                yield item

    def all_items(self, camera: str | None = None) -> Iterator[Item | RecordedState]:
        """Yield the items for a replay, with those before ``since`` and the states of cameras.

        If the rest of a file cannot be read, a state with unknown values follows.
        """
        if camera is not None:
            camera = check_text(camera, "camera", f"recording {self.path}")
        for path in self._files_of(camera):
            scan, last = _FileScan(path), None
            try:
                for item in scan.items(states=True):
                    at = _time_of(item)
                    if self.until is not None and at > self.until:
                        continue
                    if camera is None or item.camera == camera:
                        last = item.camera, at
                        yield item
            except SmartCamError as exc:
                if path == self.path:
                    raise
                scan.remark = str(exc)
            if scan.remark and path != self.path and last is not None:
                name, at = last
                yield RecordedState(name, at=at)

    def _files_of(self, camera: str | None) -> Iterator[Path]:
        for path in self.files:
            name = None if path == self.path else FileName.parse(path.name)
            if name is None or camera is None or name.camera == camera:
                yield path

    def frames(self, camera: str | None = None) -> Iterator[TraceEntry]:
        """Yield the frames on the wire; :meth:`pictures` yields the pictures."""
        return self._items_of_type(TraceEntry, camera)

    def results(self, camera: str | None = None) -> Iterator[Result]:
        """Yield the results; ``value`` consists of JSON values: dicts, lists, texts and numbers."""
        return self._items_of_type(Result, camera)

    def events(self, camera: str | None = None) -> Iterator[CameraEvent]:
        """Yield the events."""
        return self._items_of_type(CameraEvent, camera)

    def errors(self, camera: str | None = None) -> Iterator[RecordedError]:
        """Yield the errors."""
        return self._items_of_type(RecordedError, camera)

    def pictures(self, camera: str | None = None) -> Iterator[Frame]:
        """Yield the pictures with the times, numbers and losses of their source.

        ``lost`` also counts pictures that the recorder left out before the picture.
        """
        return (frame_of(item) for item in self._items_of_type(RecordedPicture, camera))

    def results_with_pictures(self, camera: str | None = None) -> Iterator[ResultWithPicture]:
        """Yield each result with its picture, if the picture is known.

        The picture was recorded for its result, or is found by its time: the first picture of the
        camera that was certainly exposed after the trigger and before the result. A result without
        a trigger of the recording client has a picture only if it was recorded for the result.
        """
        return match_pictures(self.items(camera))

    def _items_of_type(self, kind: type[T], camera: str | None) -> Iterator[T]:
        return (item for item in self.items(camera) if isinstance(item, kind))


def frame_of(picture: RecordedPicture) -> Frame:
    """Return the frame of a picture, whose ``lost`` includes pictures that were left out."""
    frame = picture.frame
    return replace(frame, lost=frame.lost + picture.left_out) if picture.left_out else frame


def check_recording(value: Recording, caller: str) -> Recording:
    """Return a recording; raise ConfigurationError for another type."""
    return check_kind(value, Recording, "recording", "what load_recording() returns", caller)


def load_recording(
    path: str | Path, *, since: datetime | None = None, until: datetime | None = None
) -> Recording:
    """Scan a recording; read a file that was cut off as far as possible.

    Args:
        path: the file; or the folder of a :class:`~smartcam.recording.FleetRecorder`, whose
            unreadable files are listed in ``remark``.
        since: time before which items are left out; with a time zone.
        until: time after which items are left out; with a time zone.

    Raises:
        ConfigurationError: the file cannot be read, is no MCAP, or is another program's; no file of
            a folder can be read; a time has no time zone.
        RecordingError: the recording exceeds a bound that real recordings do not reach, or the disk
            fails.
        MissingExtraError: the library that inflates its chunks is not installed.
    """
    path = check_path(path, "path", "recording")
    since = check_aware_datetime(since, "since", f"recording {path}")
    until = check_aware_datetime(until, "until", f"recording {path}")
    found = _FolderScan(path, since, until)
    if not path.is_dir():
        found.add_file(_FileScan(path))
        return found.recording((path,))
    files = _files_in(path, since, until)
    for file in files:
        try:
            found.add_file(_FileScan(file))
        except MissingExtraError:
            raise
        except SmartCamError as exc:
            found.remarks.append(str(exc))
    if not found.version:
        raise ConfigurationError("\n".join(found.remarks))
    return found.recording(tuple(files))


def each_item(path: Path, on_unreadable: Callable[[str], None]) -> Iterator[Item]:
    """Yield each readable item of a file or of a folder, without a scan.

    Args:
        path: the file or folder.
        on_unreadable: function that is called with a text about each unreadable part.

    Raises:
        ConfigurationError: a file cannot be read, or is no recording of smartcam.
        RecordingError: the recording exceeds a bound, or the disk fails.
    """
    for file in _files_in(path, None, None) if path.is_dir() else [path]:
        scan = _FileScan(file)
        yield from scan.items()
        if scan.remark:
            on_unreadable(f"{file}: {scan.remark}")


def _files_in(folder: Path, since: datetime | None, until: datetime | None) -> list[Path]:
    """Return the files of a folder that may have items between two times, camera by camera."""
    try:
        named = sorted((name, entry.path) for name, entry in files_of(folder))
    except OSError as exc:
        raise ConfigurationError(f"recording {folder}: {exc.strerror or exc}") from exc
    paths: list[Path] = []
    names: list[FileName | None] = [name for name, _ in named]
    for (name, path), next_name in zip(named, [*names[1:], None], strict=False):
        if next_name is not None and next_name.camera == name.camera and since is not None:
            ends_before = next_name.at + timedelta(milliseconds=1) <= since
        else:
            ends_before = False
        if not ends_before and (until is None or name.at <= until):
            paths.append(Path(path))
    if not paths:
        raise ConfigurationError(
            f"recording {folder}: no recordings of a fleet are in this folder"
            f"{' at that time' if named else ''}; expected CAMERA_TIME{SUFFIX}"
        )
    return paths


@dataclass(slots=True)
class _FolderScan:
    """The findings of a scan of files."""

    path: Path
    since: datetime | None
    until: datetime | None
    counts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(Counts._fields, 0))
    began: datetime | None = None
    ended: datetime | None = None
    version: str = ""
    names: dict[str, None] = field(default_factory=dict[str, None])
    metadata: dict[str, dict[str, str]] = field(default_factory=dict[str, dict[str, str]])
    remarks: list[str] = field(default_factory=list[str])

    def add_file(self, scan: _FileScan) -> None:
        """Add what a file holds; raises as :meth:`_FileScan.items`."""
        try:
            for item in scan.items():
                self._add_item(item)
                del item  # free it, since the next one may be large, too
        finally:
            for name, texts in scan.camera_metadata.items():
                self.metadata[name] = {**self.metadata.get(name, {}), **texts}
            _check_cameras(self.path, self.metadata)
            self.version = scan.file_metadata.get("version", self.version)
        if scan.remark:
            remark = scan.remark if scan.path == self.path else f"{scan.path.name}: {scan.remark}"
            self.remarks.append(remark)

    def _add_item(self, item: Item) -> None:
        at = _time_of(item)
        if self.until is not None and at > self.until:
            return
        self.names[item.camera] = None
        _check_cameras(self.path, self.names)
        if self.since is not None and at < self.since:
            return
        self.counts[_count_name(item)] += 1
        if isinstance(item, RecordedPicture):
            self.counts["left_out"] += item.left_out
        self.began = at if self.began is None else min(self.began, at)
        self.ended = at if self.ended is None else max(self.ended, at)

    def recording(self, files: tuple[Path, ...]) -> Recording:
        """Return the recording, with the findings in its files."""
        return Recording(
            path=self.path,
            version=self.version,
            cameras={name: _camera(name, self.metadata.get(name, {})) for name in self.names},
            counts=Counts(**self.counts),
            began=self.began,
            ended=self.ended,
            remark="\n".join(self.remarks),
            files=files,
            since=self.since,
            until=self.until,
        )


def _time_of(item: Item | RecordedState) -> datetime:
    at = item.received_at if isinstance(item, Result) else item.at
    return EPOCH if at is None else at


def _check_cameras(path: Path, names: Sized) -> None:
    if len(names) > MAX_CAMERAS:
        raise RecordingError(
            f"recording {path}: {len(names)} cameras, expected {MAX_CAMERAS} at most"
        )


def _count_name(item: Item) -> str:
    match item:
        case TraceEntry():
            return "frames"
        case Result():
            return "results"
        case RecordedError():
            return "errors"
        case RecordedPicture():
            return "pictures"
        case _:
            return "events"


def _camera(name: str, metadata: dict[str, str]) -> RecordedCamera:
    return RecordedCamera(
        name,
        metadata.get("url", ""),
        metadata.get("protocol", ""),
        metadata.get("dialect"),
        tuple(quirk for quirk in metadata.get("quirks", "").split(",") if quirk),
        metadata.get("interpret_as"),
        metadata,
    )


@dataclass(slots=True)
class _FileScan:
    """One pass through a file."""

    path: Path
    # metadata of the file; this and the next two attributes are filled during the pass
    file_metadata: dict[str, str] = field(default_factory=dict[str, str])
    # metadata of cameras, by their names
    camera_metadata: dict[str, dict[str, str]] = field(default_factory=dict[str, dict[str, str]])
    remark: str = ""  # offset and reason if the file stops being readable
    values: int = 0  # number of values in its messages so far
    # number and marks of the last message of annotations, until the next picture
    marks: tuple[int, tuple[Drawing, ...]] = (0, ())
    # data of the last frames, by camera and number
    bodies: LastBodies[tuple[str, int], str] = field(
        default_factory=LastBodies[tuple[str, int], str]
    )

    @overload
    def items(self) -> Iterator[Item]: ...

    @overload
    def items(self, *, states: Literal[True]) -> Iterator[Item | RecordedState]: ...

    def items(self, *, states: bool = False) -> Iterator[Item | RecordedState]:
        """Yield every readable item; with ``states`` also the states of cameras.

        Raises:
            ConfigurationError: the file is no recording of smartcam.
            RecordingError: the file exceeds a bound, or the disk fails.
        """
        try:
            stream = self.path.open("rb")
        except (OSError, ValueError) as exc:
            reason = exc.strerror if isinstance(exc, OSError) else exc
            raise ConfigurationError(f"recording {self.path}: {reason}") from exc
        with stream:
            self._check_magic(stream.read(8))
            stream.seek(0)
            count = 0
            kinds: dict[int, MessageKind | str] = {}
            schemas: dict[int, str] = {}
            reader = RecordReader(stream, self.path)
            records = reader.records()
            while True:
                try:
                    record = next(records)
                    item = self._read_record(record, schemas, kinds, reader)
                except StopIteration:
                    break
                except SmartCamError:
                    raise
                except OSError as exc:
                    raise RecordingError(f"recording {self.path}: {exc.strerror or exc}") from exc
                except (CutOffError, ValueError, OverflowError, RecursionError) as exc:
                    self.remark = _remark(count, exc)
                    break
                if isinstance(item, RecordedState):
                    if states:
                        yield item
                elif item is not None:
                    count += 1
                    yield item
                    item = None  # free it, since the next one may be large, too
            self._check_is_recording(schemas)

    def _read_record(
        self,
        record: Record,
        schemas: dict[int, str],
        kinds: dict[int, MessageKind | str],
        reader: RecordReader,
    ) -> Item | RecordedState | None:
        match record:
            case Schema(number, name):
                schemas[number] = name
            case Channel(number, schema):
                name = schemas.get(schema, "")
                kind = next((kind for kind in KINDS.values() if kind.schema == name), None)
                if kind is not None:
                    kinds[number] = kind
                elif name in (ANNOTATIONS_SCHEMA, *PICTURE_SCHEMAS):
                    kinds[number] = name
            case McapMessage(channel, sequence, data) if channel in kinds:
                kind_or_schema = kinds[channel]
                if isinstance(kind_or_schema, str):
                    return self._picture(kind_or_schema, sequence, data, reader)
                body = bytes(data)
                self._count_values(count_values(body), reader.offset)
                fields = message_fields(body)
                self._add_raw(fields, reader)
                item = kind_or_schema.from_json(fields)
                if isinstance(item, TraceEntry) and (hex_data := data_of(item)):
                    self.bodies.add((item.camera, sequence), hex_data, len(hex_data))
                return item
            case Metadata(name, texts) if name == FILE_METADATA:
                self.file_metadata = texts
                self._check_format()
            case Metadata(name, texts) if name == CAMERA_METADATA:
                self.camera_metadata[texts.get("camera", "")] = texts
                _check_cameras(self.path, self.camera_metadata)
            case Metadata(name, texts) if name == STATE_METADATA:
                return RecordedState.from_metadata(texts)
            case _:
                pass
        return None

    def _picture(
        self, schema: str, sequence: int, data: memoryview, reader: RecordReader
    ) -> RecordedPicture | None:
        """Return a picture with the marks right before it; None for a message of marks."""
        with from_part("frames", "pictures need"):
            from smartcam.recording._pictures import annotations, messages
        if schema == ANNOTATIONS_SCHEMA:
            self._count_values(len(data) // MIN_POINT_BYTES, reader.offset)
            self.marks = sequence, annotations.drawings_of(data)
            return None
        marks, self.marks = self.marks, (0, ())
        return messages.picture_of(schema, data, *marks)

    def _add_raw(self, fields: dict[str, Any], reader: RecordReader) -> None:
        """Add a result's bytes to its fields, if they are only in its frame."""
        raw_from = optional_field(fields, "raw_from", int)
        if raw_from is None:
            return
        raw = self.bodies.get((camera_name(fields), raw_from))
        if raw is None:
            raise ValueError(f"raw_from: {raw_from} came, expected an earlier frame that has data")
        reader.count_unpacked(len(raw))
        fields["raw"] = raw

    def _count_values(self, count: int, offset: int) -> None:
        self.values += count
        if self.values > max(VALUE_ALLOWANCE, VALUES_PER_BYTE * offset):
            raise RecordingError(
                f"recording {self.path}: {self.values} values in the messages of the first "
                f"{offset} bytes of the file, expected {VALUES_PER_BYTE} a byte at most, "
                f"or {VALUE_ALLOWANCE}"
            )

    def _check_magic(self, begin: bytes) -> None:
        if not begin.startswith(b"\x89MCAP"):
            actual = f"it begins with {begin.hex(' ')}" if begin else "it is empty"
            raise ConfigurationError(f"recording {self.path}: this is no MCAP file: {actual}")

    def _check_format(self) -> None:
        actual, version = self.file_metadata.get("format"), self.file_metadata.get("version")
        if actual not in FORMATS:
            raise ConfigurationError(
                f"recording {self.path}: its format is {actual}, this version of smartcam reads "
                f"{' and '.join(FORMATS)}; it was written by smartcam {version}"
            )

    def _check_is_recording(self, schemas: dict[int, str]) -> None:
        if not self.file_metadata:
            names = ", ".join(sorted(set(schemas.values()))[:8]) or "nothing"
            if any(name.startswith("smartcam.") for name in schemas.values()):
                raise ConfigurationError(
                    f"recording {self.path}: it holds {names}, but its metadata records are "
                    "missing, which name the program that wrote it: another program left them out. "
                    "mcap filter keeps them with --include-metadata; use the original file"
                )
            raise ConfigurationError(
                f"recording {self.path}: this MCAP file is no recording of smartcam; it holds "
                f"{names}"
            )


def _remark(count: int, cause: Exception) -> str:
    if isinstance(cause, CutOffError):
        return f"the file has no end: the recording was cut off; {count} messages were read"
    return f"the file is damaged after message {count}: {cause!s:.200}; the rest cannot be read"
