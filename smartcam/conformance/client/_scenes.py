"""Define scenes: each is a camera, mostly with a fault, and a task for a client."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from smartcam.conformance._dialects import EVERY_DIALECT, SMART_DIALECTS
from smartcam.emulator import faults as f
from smartcam.protocols import Frame

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from smartcam.conformance.client._tasks import Verb
    from smartcam.emulator import Run
    from smartcam.emulator._inside import BaseFault
    from smartcam.protocols import FramedDialect

APPLICATION, OTHER, FREE_RUNNING, MISSING = 21, 3, 9, 99
"""The application that is loaded at first, one to switch to, one that sends results unasked, and
an id that no application has."""

HOLD_SECONDS = 0.25
"""Seconds for which a message is held back: less than the timeouts of clients."""

BUSY_SECONDS = 1.0
"""Seconds of BUSY after a switch's answer: enough for a slow client to get the status with BUSY."""

WAITING_STATUS = 0x280
"""Status with Running and Waiting for Trigger."""

_CONTAINER = struct.Struct("<ii")


def container(application: int, run_number: int) -> bytes:
    """Return the data of a result: its application, and the number of the run."""
    return _CONTAINER.pack(application, run_number)


def read_container(data: bytes) -> tuple[int, int] | None:
    """Return the application and the run of a result's data; None for other data."""
    if len(data) != _CONTAINER.size:
        return None
    application, run_number = _CONTAINER.unpack(data)
    return application, run_number


def _make_application(number: int, **other: Any) -> dict[str, Any]:
    def values(run: Run) -> dict[str, int]:
        return {"application": number, "run_number": run.run_index}

    return {
        "id": number,
        "layout": "application: int32, run_number: int32",
        "generator": values,
        "load_time": 0.1,
        "processing_time": 0.02,
        **other,
    }


APPLICATIONS: tuple[dict[str, Any], ...] = (
    _make_application(APPLICATION),
    _make_application(OTHER),
    _make_application(FREE_RUNNING, rate=50.0, processing_time=0.005),
)
"""Applications that are stored on the camera."""


def _no_faults(dialect: FramedDialect) -> Sequence[BaseFault]:
    return ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """A camera, mostly with a fault, and a task for a client.

    Attributes:
        name: name of the scene.
        about: text about the special condition of the scene, for people.
        verb: verb of the task.
        number: N or ID of the task, as in :class:`~smartcam.conformance.client._tasks.Task`.
        active: application that is loaded at first.
        running: True if the camera is in run mode at first.
        faults: function that returns the faults for a dialect.
        quirks: quirks of the camera.
        stale: run numbers of inspections that the client did not trigger.
        dialects: dialects in which the scene makes sense.
        transports: transports over which the scene makes sense.
    """

    name: str
    about: str
    verb: Verb = "trigger"
    number: int | None = None
    active: int = APPLICATION
    running: bool = True
    faults: Callable[[FramedDialect], Sequence[BaseFault]] = _no_faults
    quirks: Mapping[str, Any] = field(default_factory=dict[str, Any])
    stale: frozenset[int] = frozenset()
    dialects: tuple[str, ...] = EVERY_DIALECT
    transports: tuple[str, ...] = ("tcp", "udp")

    @property
    def result_count(self) -> int:
        """Number of results that the task asks for."""
        return 1 if self.verb == "switch" else self.number or 1

    @property
    def application(self) -> int:
        """Id of the application that the results come from."""
        return self.number or 0 if self.verb == "switch" else self.active


def _insert_unknown_messages(dialect: FramedDialect) -> Sequence[BaseFault]:
    data = dialect.encode_frame(Frame(0x77, b"new in this firmware"))
    # not before the answer to Connect: until then the camera sends nothing (SC-A28, published)
    between = ("StatusReport", "QueryAnswer", "ResultContainer")
    return [f.Insert(data=data, on=name, where="before", times=None) for name in between]


def _set_unknown_bit(dialect: FramedDialect) -> Sequence[BaseFault]:
    offset = dialect.header.size  # the status word's lowest byte
    return [f.Corrupt(on="StatusReport", offset=offset, xor=0x40, times=None)]


def _insert_other_result(dialect: FramedDialect) -> Sequence[BaseFault]:
    fields: dict[str, int | str] = {"application": MISSING, "data": container(MISSING, 0).hex()}
    return [f.Insert(message="ResultContainer", fields=fields, on="ResultContainer")]


def _insert_status(dialect: FramedDialect) -> Sequence[BaseFault]:
    fields: dict[str, int | str] = {"status": WAITING_STATUS}
    return [f.Insert(message="StatusReport", fields=fields, on="QueryAnswer", times=None)]


def _split_every_byte(dialect: FramedDialect) -> Sequence[BaseFault]:
    longest = dialect.header.size + 16
    return [f.Split(after=after, pause=0.001, times=None) for after in range(1, longest)]


def _announce_impossible_length(dialect: FramedDialect) -> Sequence[BaseFault]:
    header = dialect.header
    magic = dialect.encode_frame(Frame(0x20, b""))[: len(header.magic)]
    size = b"\xff" * (4 if header.code == "I" else 2)
    message_id = (0x20).to_bytes(len(size), "little")
    data = magic + (message_id + size if header.id_first else size + message_id)
    return [f.Insert(data=data, on="ResultContainer", where="instead", times=None)]


def _fixed_faults(*faults: BaseFault) -> Callable[[FramedDialect], Sequence[BaseFault]]:
    return lambda dialect: faults


GARBAGE = bytes(range(0x9B, 0xDB))
"""Bytes that are no frame; read as a 16-bit header, they announce a body of 40,348 bytes."""

_SINGLE_FAULT_SCENES: tuple[tuple[str, str, BaseFault], ...] = (
    (
        "overtriggered",
        "every trigger is dropped, Overtriggered is set",
        f.Overtrigger(count=1_000_000),
    ),
    ("no_result", "no inspection sends a result", f.Drop(on="ResultContainer", times=None)),
    ("busy_for_ever", "BUSY never falls", f.BusyForEver()),
    ("no_connect_answer", "Connect is not answered", f.Drop(on="ConnectAnswer", times=None)),
    ("no_query_answer", "Query is not answered", f.Drop(on="QueryAnswer", times=None)),
    ("nothing_listens", "the port is closed", f.Refuse(seconds=3600)),
    (
        "closed",
        "the camera closes the connection at each trigger",
        f.Close(on="Trigger", times=None),
    ),
    (
        "reset",
        "the camera resets the connection at each trigger",
        f.Reset(on="Trigger", times=None),
    ),
    (
        "half_open",
        "nothing is heard of the camera any more from a trigger on",
        f.HalfOpen(on="Trigger", times=None),
    ),
    (
        "cut_result",
        "the connection ends in the middle of a result",
        f.Truncate(on="ResultContainer", keep=9, times=None),
    ),
)
"""Scenes that differ only by their fault."""

SCENES: Mapping[str, Scene] = {
    scene.name: scene
    for scene in (
        Scene(name="trigger", about="nothing goes wrong"),
        Scene(name="trigger_3", about="nothing goes wrong", number=3),
        Scene(name="switch", about="nothing goes wrong", verb="switch", number=OTHER),
        Scene(name="watch", about="nothing goes wrong", verb="watch", number=5, active=9),
        Scene(
            name="byte_by_byte",
            about="each byte comes by itself",
            faults=_split_every_byte,
            transports=("tcp",),
        ),
        Scene(
            name="coalesced",
            about="messages come together in one segment",
            faults=_fixed_faults(f.Coalesce(count=2, seconds=0.05, times=None)),
            number=3,
            transports=("tcp",),
        ),
        Scene(
            name="inspection_under_way",
            about="a sensor has triggered the camera right before the client's trigger",
            faults=_fixed_faults(
                f.LateResult(seconds=HOLD_SECONDS), f.DigitalInput(on="Connect", when="before")
            ),
            stale=frozenset({0}),
        ),
        Scene(
            name="result_of_another",
            about="a result of another application comes first",
            faults=_insert_other_result,
        ),
        Scene(
            name="sent_twice",
            about="the first inspection sends its result twice",
            faults=_fixed_faults(f.ExtraResult()),
            number=3,
        ),
        Scene(
            name="status_between",
            about="a status comes between a Query and its answer",
            faults=_insert_status,
        ),
        Scene(
            name="unknown_messages",
            about="messages with an unknown id come in between",
            faults=_insert_unknown_messages,
        ),
        Scene(
            name="unknown_bits",
            about="the status has a bit set that has no name",
            faults=_set_unknown_bit,
        ),
        Scene(
            name="busy_after_switch",
            about="BUSY is still set when the switch is answered",
            faults=_fixed_faults(
                f.BusyForEver(seconds=BUSY_SECONDS, on="SwitchApplication", when="after")
            ),
            verb="switch",
            number=OTHER,
            dialects=SMART_DIALECTS,
        ),
        Scene(
            name="late_switch_answer",
            about="the switch is answered after BUSY has fallen",
            faults=_fixed_faults(f.Delay(on="SwitchAnswer", seconds=HOLD_SECONDS, overtaken=True)),
            verb="switch",
            number=OTHER,
        ),
        Scene(
            name="refused_switch",
            about="no application has the id",
            verb="switch",
            number=MISSING,
        ),
        Scene(
            name="stopped",
            about="the application does not run",
            running=False,
            dialects=SMART_DIALECTS,
        ),
        *(
            Scene(name=name, about=about, faults=_fixed_faults(fault))
            for name, about, fault in _SINGLE_FAULT_SCENES
        ),
        Scene(
            name="garbage",
            about="bytes that make no frame come in place of each result",
            faults=_fixed_faults(
                f.Insert(data=GARBAGE, on="ResultContainer", where="instead", times=None)
            ),
        ),
        Scene(
            name="length_bomb",
            about="a header announces as many bytes as it can, and they never come",
            faults=_announce_impossible_length,
        ),
    )
}
"""All scenes by their names."""
