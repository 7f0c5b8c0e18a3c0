"""The values that users get: a camera's results, statuses, events and counters.

They are NamedTuples, dataclasses with slots and an ``IntFlag``: cheap to make, and immutable if
many readers share them. :func:`jsonable` makes JSON of them, with their field names.
Lengths are metres, angles radians, times seconds unless a name has another unit.
"""

from __future__ import annotations

import dataclasses
import enum
import importlib
import math
import sys
from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING, Any, Generic, Literal, NamedTuple, Protocol, cast

if TYPE_CHECKING:
    from collections.abc import Iterable

    # with a default, so that a bare Result or SmartCamera keeps its meaning
    from typing_extensions import TypeVar

    ValueT = TypeVar("ValueT", default=Any)
else:
    from typing import TypeVar

    ValueT = TypeVar("ValueT")

__all__ = [
    "ApplicationChanged",
    "Calibration",
    "CameraEvent",
    "Capabilities",
    "Connected",
    "Disconnected",
    "Header",
    "Localization",
    "NoticeReceived",
    "Pose",
    "PoseSigma",
    "Position",
    "Quaternion",
    "Reconnected",
    "Result",
    "Statistics",
    "Status",
    "StatusChanged",
    "jsonable",
]

ByteOrder = Literal["little", "big"]


class Status(enum.IntFlag):
    """The camera's status word. Bits not named here are kept.

    Source: SC manual p. 30 and p. 33 (published) for the first seven bits and their values; the
    client need not reset the bits: when a state ends, the camera sends a status without its bit.
    If a dialect's own word differs, its table maps its bits to these; a bit without a
    counterpart here is 32 bits higher than on the wire. In ``bid`` Overtriggered is the Trigger
    Error, which stays set until the errors are reset.
    """

    OVERHEAT = 0x001
    """Allowed temperature exceeded; inspections may get worse."""
    SYSTEM_ERROR = 0x002
    """Fatal: at least a reboot is needed."""
    INPUT_CONTAINER = 0x004
    """Input containers and inspections were not equally many: one was dropped, or reused."""
    BUSY = 0x010
    """Busy; set while the application is being switched."""
    RUNNING = 0x080
    """The camera is in run mode."""
    OVERTRIGGERED = 0x100
    """A trigger was dropped; transient."""
    WAITING_FOR_TRIGGER = 0x200
    """The camera would take a trigger now."""
    SIMULATION_MODE = 0x8_0000_0000
    """``bid``: the images come from files (BVS ID guide p. 210, published)."""

    @classmethod
    def _missing_(cls, value: object) -> Any:
        """Make the member for a word with unnamed bits, without keeping it.

        ``enum`` would keep every word that it has made, and the peer may send up to four thousand
        million different ones.
        """
        if not isinstance(value, int) or value < 0 or not value & ~_NAMED_BITS:
            return super()._missing_(value)
        member = int.__new__(cls, value)
        member._name_, member._value_ = None, value
        return member

    @property
    def loading(self) -> bool:
        """True while an application is being loaded: BUSY, and not running.

        Source: BUSY is set meanwhile, and the application is stopped for it (SC manual p. 33, 34,
        published).
        """
        return Status.BUSY in self and Status.RUNNING not in self

    @property
    def names(self) -> list[str]:
        """Names of the set bits, lowest first; a bit without a name as ``0x40``."""
        names: list[str] = []
        for bit in range(self.value.bit_length()):
            value = 1 << bit
            if self.value & value:
                member = Status._value2member_map_.get(value)
                name = member.name if member is not None else None
                names.append(name or f"{value:#x}")
        return names

    def __str__(self) -> str:
        """Return the set bits as text, ``"no bit set"`` for none."""
        return " + ".join(self.names) or "no bit set"


_NAMED_BITS = sum(member.value for member in Status)


def as_status(word: int) -> Status:
    """Return the status of a word; for the receiving path, since ``Status(word)`` is slow."""
    known = Status._value2member_map_.get(word)  # of named bits only, so at most 256
    return Status(word) if known is None else cast("Status", known)


MAX_RAW_BYTES_IN_REPR = 16
"""Largest number of bytes of a container that a result's repr shows."""

MAX_CHARACTERS_IN_REPR = 300
"""Largest number of characters of a value that a result's repr shows."""


def _cut(value: object) -> str:
    text = repr(value)
    return text if len(text) <= MAX_CHARACTERS_IN_REPR else f"{text[:MAX_CHARACTERS_IN_REPR]}..."


def _html() -> Any:
    return importlib.import_module("smartcam._html")  # used only by notebooks


class Position(NamedTuple):
    """A point, metres."""

    x: float
    y: float
    z: float = 0.0


class Quaternion(NamedTuple):
    """An orientation: Hamilton quaternion of unit length, real part last."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0

    @classmethod
    def from_theta(cls, theta: float) -> Quaternion:
        """Return the rotation by ``theta`` radians, counter-clockwise, about z."""
        half = 0.5 * theta
        return cls(0.0, 0.0, math.sin(half), math.cos(half))

    @property
    def theta(self) -> float:
        """The rotation about z in radians, in (-pi, pi]."""
        return math.atan2(
            2.0 * (self.w * self.z + self.x * self.y), 1.0 - 2.0 * (self.y**2 + self.z**2)
        )


class Header(NamedTuple):
    """The frame of a pose, and the time at which it arrived.

    Attributes:
        seq: the client's count of results (:attr:`Result.number`).
        stamp: time of arrival, UTC.
        frame_id: name of the frame in which the pose is given: the camera's name.
    """

    seq: int
    stamp: datetime
    frame_id: str


class PoseSigma(NamedTuple):
    """The errors that a robot may expect of a pose, as standard deviations.

    Attributes:
        x: along the frame's x axis, metres; pixels if the position is in pixels.
        y: along the frame's y axis, in the unit of ``x``.
        theta: error of the rotation about the pose's z axis, radians.
        correlation_xy: correlation of the errors of x and y, -1 to 1.
        correlation_xt: correlation of the errors of x and theta.
        correlation_yt: correlation of the errors of y and theta.
        z: along the frame's z axis, metres; None if not known: a camera sees no height.
    """

    x: float
    y: float
    theta: float
    correlation_xy: float = 0.0
    correlation_xt: float = 0.0
    correlation_yt: float = 0.0
    z: float | None = None

    @property
    def worst_xy(self) -> float:
        """The standard deviation in x and y along the worst direction, in the unit of ``x``."""
        mean, half = (self.x**2 + self.y**2) / 2, (self.x**2 - self.y**2) / 2
        return math.sqrt(mean + math.hypot(half, self.correlation_xy * self.x * self.y))

    @property
    def millimetres(self) -> float:
        """:attr:`worst_xy` in millimetres, of a pose whose position is in metres."""
        return 1e3 * self.worst_xy

    @property
    def degrees(self) -> float:
        """The standard deviation of the rotation in degrees."""
        return math.degrees(self.theta)


class Pose(NamedTuple):
    """Position and orientation in a frame."""

    header: Header
    position: Position
    orientation: Quaternion

    @property
    def sigma(self) -> PoseSigma | None:
        """The errors that the pose may have; None if not known. Comparisons leave them out."""
        return None

    def with_sigma(self, sigma: PoseSigma) -> Pose:
        """Return the pose with the errors that it may have."""
        pose = tuple.__new__(_EstimatedPose, self)
        pose.__dict__["sigma"] = sigma
        return pose


class _EstimatedPose(Pose):
    """A pose whose errors are known; a pose made of it by ``_replace`` has none."""

    @property
    def sigma(self) -> PoseSigma | None:
        known: PoseSigma | None = self.__dict__.get("sigma")
        return known

    def _asdict(self) -> dict[str, Any]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return the fields by name, with the errors: JSON has them, too."""
        return {**super()._asdict(), "sigma": self.sigma}

    def __repr__(self) -> str:
        return f"Pose({', '.join(f'{name}={value!r}' for name, value in self._asdict().items())})"


class Localization(NamedTuple):
    """One part that the camera found.

    Attributes:
        feature_id: name of the taught feature.
        quality: 0 to 1.
        photo_index: index of the photo it was found in.
        pose: pose of the part: x right, y up, theta counter-clockwise. ``pose.sigma`` is the
            error that the pose may have, if the camera sends it.
    """

    feature_id: str
    quality: float
    photo_index: int
    pose: Pose

    def _repr_html_(self) -> str:
        return str(_html().localizations_html([self]))


class Calibration(Protocol):
    """An object that transforms localizations into a robot's frame.

    The option ``calibration`` takes any object with this method, such as a
    :class:`~smartcam.calibration.PlaneCalibration`. If it has an attribute ``y_down`` that is not
    None, the camera's setting must be the same.
    """

    def to_robot(self, localizations: list[Localization], /) -> list[Localization]:
        """Return one localization for each, in the same order, with its pose in the robot's frame.

        The client calls it in its event loop, once for the localizations of each result container,
        also for an empty list; it must not wait. It may be called again for the same container.

        Args:
            localizations: localizations of one container; their header has the camera's name as its
                frame.

        Raises:
            CalibrationError: one of the localizations cannot be transformed. This error, and any
                other one, makes the whole result an :exc:`~smartcam.InterpretationError`.
        """
        ...


class Result(NamedTuple, Generic[ValueT]):
    """A decoded result container with its metadata; generic in its value.

    Attributes:
        camera: name of the camera.
        application: id of the application that made it.
        sequence: value of the layout's ``@sequence`` field, None without one.
        number: the client's own count of containers, from 1.
        triggered_at: when the trigger was sent, UTC; None without a trigger of this client.
        received_at: when its last byte arrived, UTC.
        latency: seconds from trigger to arrival (monotonic clock); None without a trigger.
        raw: the container's bytes after the application id.
        value: the interpreted value.
    """

    camera: str
    application: int
    sequence: int | None
    number: int
    triggered_at: datetime | None
    received_at: datetime
    latency: float | None
    raw: bytes
    value: ValueT

    def __repr__(self) -> str:
        """Return the fields that are not None, long ones cut."""
        raw = (
            self.raw
            if len(self.raw) <= MAX_RAW_BYTES_IN_REPR
            else self.raw[:MAX_RAW_BYTES_IN_REPR] + b"..."
        )
        shown = self._asdict() | {"raw": raw}
        fields = (f"{name}={_cut(value)}" for name, value in shown.items() if value is not None)
        return f"Result({', '.join(fields)})"

    def _repr_html_(self) -> str:
        return str(_html().result_html(self))


@dataclass(frozen=True, slots=True, kw_only=True)
class Capabilities:
    """The abilities of a camera in its dialect; calling a missing one raises UnsupportedError.

    Attributes:
        dialect: the dialect's name.
        switch: load another application by its id.
        load_file: load an application by the name of its file.
        start_stop: enter and leave run mode; otherwise the camera always runs.
        reboot: restart.
        get_clock: return the camera's time.
        set_clock: set the camera's clock.
        input_data: take input data for an inspection.
        sequence_number: set the number of the next run.
        result_codes: commands are acknowledged, or refused with a code.
        unasked_status: the status comes with the session and at every change.
        get_status: the status can be asked for.
        reset_errors: error bits stay set until they are reset.
        unasked_results: results come without a trigger of this client.
        read_image: the last picture can be read.
    """

    dialect: str
    switch: bool = False
    load_file: bool = False
    start_stop: bool = False
    reboot: bool = False
    get_clock: bool = False
    set_clock: bool = False
    input_data: bool = False
    sequence_number: bool = False
    result_codes: bool = False
    unasked_status: bool = False
    get_status: bool = False
    reset_errors: bool = False
    unasked_results: bool = False
    read_image: bool = False

    @property
    def names(self) -> list[str]:
        """Names of the abilities that the camera has."""
        return [f.name for f in dataclasses.fields(self) if getattr(self, f.name) is True]


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraEvent:
    """An event of a camera.

    Attributes:
        camera: name of the camera.
        at: when, UTC.
    """

    camera: str
    at: datetime


@dataclass(frozen=True, slots=True, kw_only=True)
class Connected(CameraEvent):
    """The first session was made; ``url`` names the dialect that was found."""

    url: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Reconnected(CameraEvent):
    """A later session was made, and the camera has reported its active application again."""

    url: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Disconnected(CameraEvent):
    """The session ended; ``reason`` is the cause, ``expected`` is True if this side ended it."""

    reason: str
    expected: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusChanged(CameraEvent):
    """The camera sent a status that differs from the one before."""

    status: Status
    previous: Status | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ApplicationChanged(CameraEvent):
    """The active application is another one than the client knew before."""

    application: int
    previous: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class NoticeReceived(CameraEvent):
    """The camera has sent a notice that is neither a status nor a result.

    Attributes:
        kind: ``"error"``, ``"notification"`` or ``"debug"``.
        code: the camera's number of the notice, 0 without one.
        text: the camera's text.
    """

    kind: str
    code: int
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SubscriberStatistics:
    """The item counts of one subscriber: ``offered == taken + dropped + queued``.

    While it was subscribed, the camera sent ``offered + missed`` items.

    Attributes:
        name: kind of the subscribed items: ``results``, ``statuses`` or ``events``.
        policy: consequence of a full queue: ``drop_oldest`` or ``error``.
        offered: items that came while it was subscribed.
        taken: items that the subscriber took.
        dropped: items lost to the policy or to ``min_interval``.
        queued: items waiting.
        queued_bytes: bytes of the queued containers; 0 for statuses and events.
        missed: items of a fleet's camera that were lost, because the program had no connection to
            its agent for longer than the agent keeps them; 0 for a directly connected camera.
    """

    name: str
    policy: str
    offered: int
    taken: int
    dropped: int
    queued: int
    queued_bytes: int = 0
    missed: int = 0


@dataclass(frozen=True, slots=True)
class Histogram:
    """A histogram of durations.

    Attributes:
        bounds: upper bounds of the bins, seconds, each included; the last bin has no bound.
        counts: number of durations in each bin; one more item than ``bounds``.
        total: sum of all durations, seconds.
        shortest: the shortest duration, seconds; None before the first.
        longest: the longest duration, seconds; None before the first.
    """

    bounds: tuple[float, ...]
    counts: tuple[int, ...]
    total: float = 0.0
    shortest: float | None = None
    longest: float | None = None

    @property
    def count(self) -> int:
        """Number of all durations."""
        return sum(self.counts)


HISTOGRAM_BOUNDS = tuple(
    round(step * 10.0**decade, 9) for decade in range(-4, 2) for step in (1, 2, 5)
)
"""Upper bounds of the bins, seconds: 0.1 ms to 50 s, three in a decade."""


def _empty_histogram() -> Histogram:
    return Histogram(HISTOGRAM_BOUNDS, (0,) * (len(HISTOGRAM_BOUNDS) + 1))


@dataclass(frozen=True, slots=True, kw_only=True)
class Statistics:
    """The counts since the client was made, over all its sessions.

    Each result container that arrives is counted in exactly one way, so ``received == triggered +
    streamed + late + wrong_application + uninterpretable + unclaimed``.

    Attributes:
        received: result containers that arrived.
        triggered: results of this client's triggers.
        streamed: results without a trigger of this client, while there was a subscriber.
        late: results that came after their trigger had given up.
        wrong_application: containers from another application than expected; not interpreted.
        uninterpretable: containers that could not be interpreted, or not be calibrated.
        unclaimed: results without a trigger of this client and without a subscriber.
        empty_slots: all-zero records skipped by interpreters.
        extra_results: containers that came for a trigger which had its results already; they are
            counted as streamed or unclaimed too.
        inspections_by_others: inspections triggered by something else, a sensor or a person:
            Waiting for Trigger ended without a trigger of this client. Counted over TCP if the
            camera sends its status by itself.
        overtriggers: times the Overtriggered bit rose.
        notices: errors, notifications and other remarks of the camera's own; the log has the first
            few of each minute.
        sessions: sessions made.
        reconnects: sessions made after the first.
        frames_received: whole frames from the camera.
        frames_sent: frames to the camera.
        bytes_received: bytes from the camera.
        bytes_sent: bytes to the camera.
        ignored_datagrams: datagrams that were dropped as broken, or because they came faster than
            the client could read; on TCP a broken frame ends the link.
        unknown_ids: messages with an id that the dialect does not know.
        unexpected_messages: answers that no request waited for any more.
        long_bodies: known messages whose body was longer than documented.
        last_error: text of the last error of a link, or None.
        round_trip: seconds from a request to its answer, without switches, which take long.
        processing: seconds from a trigger to its result.
        subscribers: item counts of each subscriber that has not ended.
    """

    received: int = 0
    triggered: int = 0
    streamed: int = 0
    late: int = 0
    wrong_application: int = 0
    uninterpretable: int = 0
    unclaimed: int = 0
    empty_slots: int = 0
    extra_results: int = 0
    inspections_by_others: int = 0
    overtriggers: int = 0
    notices: int = 0
    sessions: int = 0
    reconnects: int = 0
    frames_received: int = 0
    frames_sent: int = 0
    bytes_received: int = 0
    bytes_sent: int = 0
    ignored_datagrams: int = 0
    unknown_ids: int = 0
    unexpected_messages: int = 0
    long_bodies: int = 0
    last_error: str | None = None
    round_trip: Histogram = field(default_factory=_empty_histogram)
    processing: Histogram = field(default_factory=_empty_histogram)
    subscribers: list[SubscriberStatistics] = field(default_factory=list[SubscriberStatistics])


def jsonable(value: object) -> Any:
    """Return ``value`` as objects that ``json.dumps`` takes, with the models' field names.

    Bytes become hex, times ISO 8601, a status the list of its bits' names, NaN and infinity null
    (JSON has no word for them), numpy arrays lists (structured ones lists of objects).
    """
    if isinstance(value, Status):
        return value.names
    if isinstance(value, enum.Enum):
        return value.value
    if value is None or isinstance(value, (bool, int, str)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, (bytes, bytearray, memoryview)):
        return value.hex()
    return _jsonable_container(value)


def _jsonable_container(value: Any) -> Any:
    # numpy is not imported for this; another thread may be importing it just now
    numpy = sys.modules.get("numpy")
    arrays = getattr(numpy, "ndarray", ()), getattr(numpy, "generic", ())
    if hasattr(value, "_asdict"):
        return {name: jsonable(item) for name, item in value._asdict().items()}
    if dataclasses.is_dataclass(value):
        return {f.name: jsonable(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if hasattr(value, "items"):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [jsonable(item) for item in cast("Iterable[Any]", value)]
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, arrays):
        return _jsonable_array(value.tolist(), value.dtype.names)
    if hasattr(value, "model_dump"):
        return jsonable(value.model_dump())
    return str(value)


def _jsonable_array(value: Any, names: tuple[str, ...] | None) -> Any:
    if names is None:
        return jsonable(value)
    if isinstance(value, list):
        rows: list[Any] = value
        return [_jsonable_array(row, names) for row in rows]
    return {name: _text_or_hex(item) for name, item in zip(names, value, strict=True)}


def _text_or_hex(item: object) -> Any:
    if isinstance(item, bytes):
        try:
            return item.decode()
        except UnicodeDecodeError:
            return item.hex()
    return jsonable(item)
