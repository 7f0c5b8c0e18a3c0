"""Convert a recording to a rosbag2, with the recorded values or with results interpreted again."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from smartcam._arguments import check_flag, check_path
from smartcam._client._inside import Interpretation
from smartcam.exceptions import (
    ConfigurationError,
    InterpretationError,
    RecordingError,
    RosMessageError,
    UnsupportedError,
)
from smartcam.observers import TraceEntry
from smartcam.protocols import BVS
from smartcam.protocols.messages import ResultContainer
from smartcam.recording._bags.items import BagCounts, BagItems, BagResult, localizations_from_json
from smartcam.recording._bags.recorder import DISTRIBUTION, open_bag
from smartcam.recording._bags.writer import remove_folder
from smartcam.recording._reader import check_recording
from smartcam.ros2 import RosTypes

if TYPE_CHECKING:
    from collections.abc import Generator
    from pathlib import Path

    from smartcam.models import Result
    from smartcam.recording._mcap.form import Item
    from smartcam.recording._reader import RecordedCamera, Recording


def write_bag(
    recording: Recording,
    path: str | Path,
    *,
    camera: str | None = None,
    interpret_as: Any = None,
    y_down: bool | None = None,
    calibration: Any = None,
    overwrite: bool = False,
) -> BagCounts:
    """Convert a recording to a rosbag2, in its order and with its times.

    Without ``interpret_as`` and ``calibration`` the values are the recorded ones. With one of them
    each result's bytes are interpreted again; results whose bytes cannot be interpreted so are
    written with the error, and counted.

    Args:
        recording: recording to read.
        path: the bag's folder.
        camera: name of the camera to write; default all cameras.
        interpret_as: interpreter of results, as for :func:`smartcam.connect`; with a calibration
            the default is the recorded one, or ``localizations`` if none was recorded.
        y_down: the camera's y axis points down; default as recorded.
        calibration: calibration that transforms localizations into the robot's frame, as for
            :func:`smartcam.connect`.
        overwrite: replace an existing bag.

    Returns:
        Counts of the bag.

    Raises:
        ConfigurationError: there is no such camera, an option is wrong, or the folder exists
            already or cannot be created.
        UnsupportedError: the results of a camera cannot be interpreted again from their bytes.
        RecordingError: the bag cannot be written to its end; it is removed.
        MissingExtraError: a library is not installed.
    """
    conversion = BagConversion(
        check_recording(recording, "bag"),
        check_path(path, "path", "bag"),
        camera,
        interpret_as,
        None if y_down is None else check_flag(y_down, "y_down", "bag"),
        calibration,
        check_flag(overwrite, "overwrite", "bag"),
    )
    for _ in conversion.steps():
        pass
    return conversion.counts


@dataclass(eq=False)
class BagConversion:
    """Converts a recording to a bag item by item; the fields are arguments of `write_bag`."""

    recording: Recording
    folder: Path
    camera: str | None
    interpret_as: Any
    y_down: bool | None
    calibration: Any
    overwrite: bool
    _items: BagItems = field(init=False)

    def __post_init__(self) -> None:
        cameras = self.recording.cameras
        chosen = (
            [*cameras.values()] if self.camera is None else [self.recording.camera(self.camera)]
        )
        interprets_again = self.interpret_as is not None or self.calibration is not None
        reinterpreted_cameras = chosen if interprets_again else []
        self._interpreters = {
            camera.name: self._make_interpreter(camera) for camera in reinterpreted_cameras
        }
        self._items = BagItems(RosTypes(DISTRIBUTION), self._interpret)
        for camera in chosen:
            metadata = {"interpret_as": self._spec(camera)} if interprets_again else camera.metadata
            self._items.describe({**metadata, "camera": camera.name})

    @property
    def counts(self) -> BagCounts:
        """Counts of the bag so far."""
        return self._items.counts

    def steps(self) -> Generator[None, None, None]:
        """Write the bag, one item in each step; if the generator is closed early, remove the bag.

        Raises as :func:`write_bag`.
        """
        if self.recording.path.resolve().parent == self.folder.resolve():
            raise ConfigurationError(
                f"bag {self.folder}: the recording {self.recording.path} is in this folder"
            )
        writer = open_bag(self.folder, overwrite=self.overwrite)
        try:
            with contextlib.closing(writer):
                writer.start()
                for item in self.recording.items(self.camera):
                    self._track_byte_order(item)
                    for message in self._items.messages(item):
                        writer.add(*message)
                    yield
                writer.finish()
        except BaseException as exc:
            with contextlib.suppress(OSError):
                remove_folder(self.folder)
            if isinstance(exc, (OSError, RosMessageError)):
                reason = getattr(exc, "strerror", None) or exc
                raise RecordingError(f"bag {self.folder}: {reason}") from exc
            raise

    def _spec(self, camera: RecordedCamera) -> Any:
        """Return ``interpret_as`` for a camera, as given or recorded."""
        if self.interpret_as is not None:
            return self.interpret_as
        return camera.interpret_as or "localizations"

    def _make_interpreter(self, camera: RecordedCamera) -> _ResultInterpreter:
        if camera.dialect not in BVS.dialects and camera.protocol != "bvs":
            raise UnsupportedError(
                f"bag: camera {camera.name!r} speaks {camera.protocol or 'no known protocol'} "
                f"(dialect {camera.dialect}): only results of bvs can be interpreted again; "
                "without interpret_as and calibration the recorded values are used"
            )
        y_down = camera.metadata.get("y_down") == "True" if self.y_down is None else self.y_down
        spec = self._spec(camera)
        interpretation = Interpretation(
            spec,
            lenient=camera.metadata.get("lenient") == "True",
            y_down=y_down,
            calibration=self.calibration,
            strict_calibration=self.interpret_as is not None,
        )
        endian = camera.metadata.get("endian", "0")
        if endian not in {"0", "1"}:
            raise ConfigurationError(f"recording: endian: expected 0 or 1, got {endian:.20}")
        return _ResultInterpreter(interpretation, int(endian))

    def _track_byte_order(self, item: Item) -> None:
        if isinstance(item, TraceEntry) and item.message == "StatusReport" and self._interpreters:
            self._interpreters[item.camera].set_byte_order(item)

    def _interpret(self, result: Result) -> BagResult:
        """Return a result as it is written to the bag."""
        if self._interpreters:
            return self._interpreters[result.camera].interpret(result)
        if result.value == result.raw.hex():  # a recording has bytes as hexadecimal text
            return BagResult(result._replace(value=result.raw))
        localizations = localizations_from_json(result.value)
        return BagResult(result if localizations is None else result._replace(value=localizations))


@dataclass(eq=False)
class _ResultInterpreter:
    """Interprets one camera's results again."""

    _interpretation: Interpretation
    _endian: int

    def set_byte_order(self, entry: TraceEntry) -> None:
        """Use the byte order of a status for the next results."""
        endian = (entry.fields or {}).get("endian")
        if isinstance(endian, int):
            self._endian = endian

    def interpret(self, result: Result) -> BagResult:
        """Return the result with the value of its bytes, or the error."""
        container = ResultContainer(application=result.application, data=result.raw)
        try:
            value, sequence, _ = self._interpretation(
                container,
                self._endian,
                camera=result.camera,
                number=result.number,
                at=result.received_at,
            )
        except InterpretationError as exc:
            return BagResult(result, f"{type(exc).__name__}: {exc}", was_reinterpreted=True)
        return BagResult(result._replace(value=value, sequence=sequence), was_reinterpreted=True)
