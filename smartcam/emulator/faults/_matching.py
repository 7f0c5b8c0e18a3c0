"""Match faults with messages; keep the faults that wait, and the last ones that happened."""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from smartcam.emulator.faults import (
    FAULTS,
    MAX_FAULTS,
    MAX_FIRED,
    FiredFault,
    Insert,
    OperatorSwitch,
    make_faults,
)
from smartcam.emulator.faults._base import MESSAGE_NAMES, WireFault
from smartcam.exceptions import (
    ConfigurationError,
    LocalProtocolError,
    MessageError,
    UnsupportedError,
)
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from collections.abc import Container, Iterable, Mapping

    from smartcam.emulator._clock import Clock
    from smartcam.emulator.faults import Fault
    from smartcam.emulator.faults._base import BaseFault
    from smartcam.emulator.faults._wire_effects import WireCodec
    from smartcam.protocols import Frame

_log = logging.getLogger("smartcam.emulator")


@dataclass(slots=True, eq=False)
class WaitingFault:
    """A fault that waits for messages, and how many it has seen."""

    fault: Fault
    times_left: int | None  # number of times that it will still apply; None: always
    fitting_count: int = 0  # messages that fitted so far

    def count_message(self) -> bool:
        """Count a message that fits; return True if the fault applies to this message."""
        self.fitting_count += 1
        if self.fitting_count < self.fault.nth:
            return False
        if self.times_left is not None:
            self.times_left -= 1
        return True


@dataclass(eq=False)
class FaultQueue:
    """The faults that wait, in the order in which they were given.

    The lists stay the same objects, so that links can check cheaply whether a list is empty.
    """

    _dialect: WireCodec
    _clock: Clock  # clock of the times in the record
    _applications: Container[int] = ()  # ids of the camera's applications
    _supported_kinds: frozenset[str] = frozenset(FAULTS)  # kinds of faults that the camera can do

    def __post_init__(self) -> None:
        self.camera_wire_faults: list[WaitingFault] = []
        self.client_wire_faults: list[WaitingFault] = []
        self.camera_device_faults: list[WaitingFault] = []
        self.client_device_faults: list[WaitingFault] = []
        # the last faults that have happened, oldest first
        self.fired: deque[FiredFault] = deque(maxlen=MAX_FIRED)
        self._at_once: list[WaitingFault] = []
        self._all: list[WaitingFault] = []

    @property
    def waiting(self) -> list[Fault]:
        """The faults that wait, in the order in which they were given."""
        return [each.fault for each in self._all]

    def add(self, given: Iterable[BaseFault | Mapping[str, Any]]) -> None:
        """Add faults after the waiting ones.

        Raises:
            ConfigurationError: one of the faults is wrong, or too many would wait; none was added.
        """
        faults = make_faults(given)
        for number, fault in enumerate(faults, start=1):
            self._check(number, fault)
        if len(self._all) + len(faults) > MAX_FAULTS:
            raise ConfigurationError(f"at most {MAX_FAULTS} faults can wait at one time")
        for fault in faults:
            waiting_fault = WaitingFault(fault, fault.times)
            self._all.append(waiting_fault)
            self._list_of(fault).append(waiting_fault)

    def by_frame(self, candidates: list[WaitingFault], frame: Frame) -> list[Fault]:
        """Return the faults among ``candidates`` that a client's frame triggers, in order."""
        if not candidates:
            return []
        try:
            message = self._dialect.decode(m.Sender.CLIENT, frame)
        except MessageError:
            message = m.UnknownMessage(message_id=frame.message_id, payload=frame.payload)
        name = self._dialect.message_type(m.Sender.CLIENT, frame.message_id).__name__
        return self._fire_matching(candidates, name, frame.message_id, message)

    def by_message(self, candidates: list[WaitingFault], message: m.Message) -> list[Fault]:
        """Return the faults among ``candidates`` that a message triggers, as :meth:`by_frame`."""
        number = self._dialect.message_id(message)
        is_unknown = isinstance(message, m.UnknownMessage)  # the camera refuses with the id alone
        kind = type(message) if is_unknown else self._dialect.message_type(message.sender, number)
        return self._fire_matching(candidates, kind.__name__, number, message)

    def at_once(self) -> list[Fault]:
        """Remove and return the faults that wait for no message, in order."""
        candidates = list(self._at_once)
        self._forget(candidates)
        return self._record([each.fault for each in candidates], None)

    def clear(self) -> None:
        """Forget all waiting faults."""
        self._forget(list(self._all))

    def _fire_matching(
        self, candidates: list[WaitingFault], name: str, message_id: int, message: m.Message
    ) -> list[Fault]:
        fired = [
            each
            for each in candidates
            if each.fault.fits(name, message_id) and each.count_message()
        ]
        self._forget([each for each in fired if each.times_left == 0])
        return self._record([each.fault for each in fired], message)

    def _record(self, faults: list[Fault], message: m.Message | None) -> list[Fault]:
        for fault in faults:
            _log.info("= fault: %r, on %s", fault, message)
            self.fired.append(FiredFault(self._clock.now, fault, message))
        return faults

    def _forget(self, candidates: list[WaitingFault]) -> None:
        for each in candidates:
            self._list_of(each.fault).remove(each)
            self._all.remove(each)

    def _list_of(self, fault: Fault) -> list[WaitingFault]:
        sender = fault.awaited_sender
        if sender is None:
            return self._at_once
        if isinstance(fault, WireFault):
            return self.camera_wire_faults if sender is m.Sender.CAMERA else self.client_wire_faults
        return self.camera_device_faults if sender is m.Sender.CAMERA else self.client_device_faults

    def _check(self, number: int, fault: Fault) -> None:
        """Refuse a fault that this camera does not support."""
        problem = find_unsupported(fault, self._dialect, self._applications, self._supported_kinds)
        if problem is not None:
            field, text = problem
            raise ConfigurationError(f"fault {number}: {fault.kind}.{field}: {text}")


def find_unsupported(
    fault: Fault,
    dialect: WireCodec,
    applications: Container[int],
    kinds: Container[str] = FAULTS,
) -> tuple[str, str] | None:
    """Return the unsupported field of a fault and the reason, None if all is supported."""
    if fault.kind not in kinds:
        supported = ", ".join(kind for kind in FAULTS if kind in kinds)
        return "kind", f"dialect {dialect.label}: its camera has no such fault; it has {supported}"
    if isinstance(fault.on, str) and not dialect.has(MESSAGE_NAMES[fault.on]):
        return "on", f"dialect {dialect.label} has no {fault.on}"
    if isinstance(fault, Insert) and fault.inserted is not None:
        try:
            dialect.encode(fault.inserted)
        except LocalProtocolError as exc:
            return "fields", str(exc)
        except UnsupportedError:
            return "message", f"dialect {dialect.label} has no {fault.message}"
    if isinstance(fault, OperatorSwitch) and fault.application not in applications:
        return "application", f"the camera has no application {fault.application}"
    return None
