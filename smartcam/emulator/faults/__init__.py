"""Faults: exact misbehaviour of an emulated camera and its wire, as data.

A fault says which message it waits for and what happens then. Give a list of them to
:class:`~smartcam.emulator.EmulatedCamera`, or inject them while it runs::

    EmulatedCamera(faults=[faults.Drop(on="QueryAnswer"), {"kind": "reset", "on": "Trigger"}])

Which message: ``on`` names its type, or gives its id on the wire. Each fault counts the messages
that fit, from the moment it was given and for itself alone: what other faults do to them does not
change the count, and what faults insert or duplicate is not counted. It applies to the ``nth`` one
and to those directly behind it, ``times`` in all. Where several apply to one message, they act in
the order in which they were given, each on what the one before has left of it.

*Wire faults* change what passes the wire. Those on messages of the camera count what it says to a
client, those on messages of a client count whole frames of any client, before the camera hears
them. *Device faults* are things that happen to the camera. They count what its device handles: a
Connect, and the messages of the session.

There is no chance in any of it: the same list and the same messages give the same bytes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, TypeAlias, get_args

from pydantic import Field, TypeAdapter, ValidationError

from smartcam.emulator.faults.base import (
    MAX_BYTES,
    MESSAGE_NAMES,
    BaseFault,
    DeviceFault,
    WireFault,
)
from smartcam.emulator.faults.device import (
    BusyForEver,
    ByteOrder,
    ClearFaults,
    Condition,
    DigitalInput,
    ExtraResult,
    LateResult,
    MovePart,
    NoResult,
    Overtrigger,
    Reboot,
    Refuse,
    RemovePart,
    SecondClient,
    Start,
    Stop,
    SwitchApplication,
)
from smartcam.emulator.faults.wire import (
    Close,
    Coalesce,
    Corrupt,
    Delay,
    Drop,
    Duplicate,
    HalfOpen,
    Insert,
    Reset,
    Split,
    Truncate,
)
from smartcam.exceptions import ConfigurationError
from smartcam.settings import validation_text

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from smartcam.protocols import messages as m

__all__ = [
    "FAULTS",
    "MAX_BYTES",
    "MAX_FAULTS",
    "MAX_FIRED",
    "MESSAGE_NAMES",
    "BaseFault",
    "BusyForEver",
    "ByteOrder",
    "ClearFaults",
    "Close",
    "Coalesce",
    "Condition",
    "Corrupt",
    "Delay",
    "DeviceFault",
    "DigitalInput",
    "Drop",
    "Duplicate",
    "ExtraResult",
    "Fault",
    "FiredFault",
    "HalfOpen",
    "Insert",
    "LateResult",
    "MovePart",
    "NoResult",
    "Overtrigger",
    "Reboot",
    "Refuse",
    "RemovePart",
    "Reset",
    "SecondClient",
    "Split",
    "Start",
    "Stop",
    "SwitchApplication",
    "Truncate",
    "WireFault",
    "make_faults",
]

MAX_FAULTS = 10_000
"""Faults that wait at one time; every message is compared with all of them."""

MAX_FIRED = 1000
"""Records kept of faults that have happened; the oldest go first."""

_Any: TypeAlias = (
    Delay
    | Split
    | Coalesce
    | Truncate
    | Corrupt
    | Drop
    | Duplicate
    | Insert
    | HalfOpen
    | Reset
    | Close
    | Refuse
    | BusyForEver
    | Overtrigger
    | SecondClient
    | Reboot
    | SwitchApplication
    | Stop
    | Start
    | Condition
    | LateResult
    | NoResult
    | ExtraResult
    | DigitalInput
    | ByteOrder
    | MovePart
    | RemovePart
    | ClearFaults
)

Fault: TypeAlias = Annotated[_Any, Field(discriminator="kind")]
"""Any fault; as a field's type in pydantic it takes mappings with ``kind``."""

FAULTS: Mapping[str, type[WireFault | DeviceFault]] = {
    kind.model_fields["kind"].default: kind for kind in get_args(_Any)
}
"""Every fault by its ``kind``."""

_ADAPTER: TypeAdapter[Fault] = TypeAdapter(Fault)


class FiredFault(NamedTuple):
    """A fault that has happened.

    Attributes:
        time: of the emulator's clock, seconds.
        fault: which one, as it was given.
        message: the message it applied to, as its sender meant it; None where it waited for none.
    """

    time: float
    fault: Fault
    message: m.Message | None


def make_faults(given: Iterable[BaseFault | Mapping[str, Any]]) -> tuple[Fault, ...]:
    """Return faults; mappings are made to them by their ``kind``.

    Raises:
        ConfigurationError: one is wrong; the text says which, counted from 1, and names the field.
    """
    made: list[Fault] = []
    for number, one in enumerate(given, start=1):
        try:
            made.append(_ADAPTER.validate_python(one))
        except ValidationError as exc:
            raise ConfigurationError(f"fault {number}: {validation_text(exc)}") from exc
    return tuple(made)
