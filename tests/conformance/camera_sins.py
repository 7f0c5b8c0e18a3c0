"""Faults of cameras: each entry makes an emulated camera fail one check."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable, Iterator, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from smartcam.emulator._inside import ClientLink
from smartcam.models import Status
from smartcam.protocols import Frame
from smartcam.protocols import messages as m

Emulator = Any  # its inside is changed here


class Sin(NamedTuple):
    """A camera that fails a check."""

    check: str  # the check's name
    do: Callable[[Emulator], None]  # changes an emulator
    came: str  # what the finding shows
    dialect: str = "handbook"  # what it speaks
    transport: str = "tcp"  # over what
    camera: Mapping[str, Any] = MappingProxyType({})  # further options of the emulator


# ---------------------------------------------------------------------- ways to sin


def says(change: Callable[[Any, m.Message], Iterator[m.Message]]) -> Callable[[Emulator], None]:
    """Change what the camera says, message by message."""

    def do(emulator: Emulator) -> None:
        device = emulator.device
        take = device.take_output
        device.take_output = lambda: [changed for one in take() for changed in change(device, one)]

    return do


def replaced(kind: type[m.Message], **fields: Any) -> Callable[[Emulator], None]:
    """Send other values in messages of a kind."""

    def change(_: Any, message: m.Message) -> Iterator[m.Message]:
        yield dataclasses.replace(message, **fields) if isinstance(message, kind) else message

    return says(change)


def dropped(*kinds: type[m.Message]) -> Callable[[Emulator], None]:
    """Do not say messages of a kind."""

    def change(_: Any, message: m.Message) -> Iterator[m.Message]:
        if not isinstance(message, kinds):
            yield message

    return says(change)


def doubled(kind: type[m.Message]) -> Callable[[Emulator], None]:
    """Send messages of a kind twice."""

    def change(_: Any, message: m.Message) -> Iterator[m.Message]:
        yield message
        if isinstance(message, kind):
            yield message

    return says(change)


def without(bits: Status) -> Callable[[Emulator], None]:
    """Never set some bits of the status."""

    def change(_: Any, message: m.Message) -> Iterator[m.Message]:
        if isinstance(message, m.StatusReport):
            message = dataclasses.replace(message, status=Status(message.status & ~bits))
        yield message

    return says(change)


def hears(change: Callable[[Emulator, Any, m.Message], bool]) -> Callable[[Emulator], None]:
    """Check each message of a client first; true if the camera must not receive it."""

    def do(emulator: Emulator) -> None:
        handle = emulator.handle_message

        def hear(link: Any, message: m.Message) -> None:
            if not change(emulator, link, message):
                handle(link, message)

        emulator.handle_message = hear

    return do


def deaf(*kinds: type[m.Message]) -> Callable[[Emulator], None]:
    """Do not hear messages of a kind."""
    return hears(lambda _, __, message: isinstance(message, kinds))


def write(emulator: Emulator, link: Any, *messages: m.Message) -> None:
    """Send something on a link, with or without a session."""
    link._write_frames([emulator.wire_dialect.encode(message) for message in messages])


def answers(kind: type[m.Message], answer: m.Message) -> Callable[[Emulator], None]:
    """Answer messages of a kind that are not to be answered."""

    def change(emulator: Emulator, link: Any, message: m.Message) -> bool:
        if isinstance(message, kind):
            write(emulator, link, answer)
        return False

    return hears(change)


def takes(change: Callable[[Emulator, Any, bytes], bytes]) -> Callable[[Emulator], None]:
    """Change the bytes that come; needs :func:`open_to_bytes`."""

    def do(emulator: Emulator) -> None:
        emulator.taken = change

    return do


_take = ClientLink._handle_bytes


def open_to_bytes(self: Any, data: bytes) -> None:
    """Receive bytes as a link does, after :func:`takes` has changed them."""
    change = getattr(self._owner, "taken", None)
    _take(self, data if change is None else change(self._owner, self, data))


# ---------------------------------------------------------------------- the sins


def _empty(message_id: int) -> m.UnknownMessage:
    return m.UnknownMessage(message_id=message_id, payload=b"")


QUERY_ANSWER = m.QueryAnswer(application=5)
NO_STATUS = m.StatusReport(status=Status(0))


def _forget_first_status(emulator: Emulator) -> None:
    emulator.device.behaviour = dataclasses.replace(
        emulator.device.behaviour, status_with_session=False
    )


def _big(emulator: Emulator) -> None:
    emulator.device.set_endian(1)


def _leave(emulator: Emulator, link: Any, message: m.Message) -> bool:
    if isinstance(message, m.Disconnect) and not emulator.serves(link):
        link.close("a Disconnect without a session")
    return False


def _start_at_disconnect(emulator: Emulator, link: Any, message: m.Message) -> bool:
    if isinstance(message, m.Disconnect):
        emulator.device._enter_run_mode()
    return False


def _one_in_a_segment(emulator: Emulator, link: Any, message: m.Message) -> bool:
    if not isinstance(message, m.Query):
        return False
    served = getattr(emulator, "served", False)
    emulator.served = True
    asyncio.get_running_loop().call_soon(setattr, emulator, "served", False)
    return served


def _no_pieces(emulator: Emulator, _: Any, data: bytes) -> bytes:
    return data if len(data) >= emulator.wire_dialect.header.size else b""


def _query_without_session(emulator: Emulator, link: Any, data: bytes) -> bytes:
    query, disconnect = map(emulator.wire_dialect.encode, (m.Query(), m.Disconnect()))
    outside = not emulator.serves(link) or data.startswith(disconnect)
    if outside and data.endswith(query):
        write(emulator, link, QUERY_ANSWER)
    return data


def _any_magic(emulator: Emulator, _: Any, data: bytes) -> bytes:
    magic: bytes = emulator.wire_dialect.header.magic
    return magic + data[len(magic) :]


def _any_datagram(emulator: Emulator, link: Any, data: bytes) -> bytes:
    if len(data) == emulator.wire_dialect.header.size - 1:
        write(emulator, link, QUERY_ANSWER)
    return data


def _no_start(emulator: Emulator) -> None:
    emulator.device._enter_run_mode = lambda: None


def _no_stop(emulator: Emulator) -> None:
    emulator.device._leave_run_mode = lambda: None


def _only_says_stopped(emulator: Emulator) -> None:
    stopped: list[bool] = []

    def hear(emulator: Emulator, link: Any, message: m.Message) -> bool:
        if isinstance(message, m.Stop):
            stopped.append(True)
            write(emulator, link, NO_STATUS)
        return isinstance(message, m.Stop)

    def say(_: Any, message: m.Message) -> Iterator[m.Message]:
        if not (stopped and isinstance(message, m.StatusReport)):
            yield message

    hears(hear)(emulator)
    says(say)(emulator)


def _never_busy_waiting(device: Any, message: m.Message) -> Iterator[m.Message]:
    if not (isinstance(message, m.StatusReport) and device.processing):
        yield message


def _result_when_stopped(emulator: Emulator, link: Any, message: m.Message) -> bool:
    if isinstance(message, m.Trigger) and not emulator.device.running:
        write(emulator, link, m.ResultContainer(application=5, data=bytes(8)))
    return False


def _complain(emulator: Emulator) -> None:
    emulator.device.behaviour = dataclasses.replace(
        emulator.device.behaviour, answers_bad_messages=True
    )


def _keep_bad_date(emulator: Emulator, link: Any, message: m.Message) -> bool:
    if isinstance(message, m.SetClock) and message.month > 12:
        replaced(m.ClockAnswer, month=message.month)(emulator)
    return False


def _runs_after_boot(emulator: Emulator) -> None:
    device = emulator.device
    boot = device._finish_boot

    def finish() -> None:
        boot()
        device._enter_run_mode()

    device._finish_boot = finish


def _unknown_answer(emulator: Emulator, link: Any, message: m.Message) -> bool:
    if isinstance(message, m.Query) and emulator.serves(link):
        link._write_frames([emulator.wire_dialect.encode_frame(Frame(0x44, b""))])
    return False


FREE_RUNNING = {
    "applications": [
        {
            "id": 5,
            "layout": "n: int32",
            "constant": {"n": 1},
            "rate": 50,
            "load_time": 0.06,
            "processing_time": 0.01,
        }
    ]
}

SINS = (
    Sin("connect-is-answered", replaced(m.ConnectAnswer, version=2), "version=2"),
    Sin("connect-is-answered", dropped(m.ConnectAnswer), "nothing", transport="udp"),
    Sin("status-follows-connect", _forget_first_status, "ConnectAnswer"),
    Sin("endian-field-is-0", _big, "endian=1"),
    Sin("query-is-answered", replaced(m.QueryAnswer, application=0), "application=0"),
    Sin("query-is-answered", replaced(m.QueryAnswer, code=0), "code=0", "bid"),
    Sin("deaf-before-connect", takes(_query_without_session), "QueryAnswer"),
    Sin("silent-after-disconnect", answers(m.Disconnect, _empty(2)), "id 0x02"),
    Sin("silent-after-disconnect", answers(m.Disconnect, NO_STATUS), "Status", "bid", "udp"),
    Sin("deaf-after-disconnect", takes(_query_without_session), "QueryAnswer"),
    Sin("no-result-after-disconnect", deaf(m.Disconnect), "ResultContainer"),
    Sin("disconnect-without-session-is-harmless", hears(_leave), "has ended the link"),
    Sin("state-survives-session", hears(_start_at_disconnect), "(5, True)"),
    Sin("newcomer-wins", takes(_query_without_session), "QueryAnswer", transport="udp"),
    Sin("messages-share-a-segment", hears(_one_in_a_segment), "QueryAnswer"),
    Sin("a-message-may-come-in-pieces", takes(_no_pieces), "nothing"),
    Sin("start-begins-run-mode", _no_start, "the status stays 0x0"),
    Sin("second-start-is-harmless", answers(m.Start, _empty(0x41)), "id 0x41"),
    Sin("trigger-gives-one-result", doubled(m.ResultContainer), "2 results"),
    Sin("trigger-gives-one-result", replaced(m.ResultContainer, application=9), "application=9"),
    Sin("trigger-is-acknowledged", replaced(m.TriggerAnswer, code=0x10), "code=16", "bid"),
    Sin("waiting-falls-and-rises", says(_never_busy_waiting), "ResultContainer"),
    Sin("dropped-trigger-is-reported", without(Status.OVERTRIGGERED), "ResultContainer"),
    Sin(
        "overtriggered-falls-by-itself",
        lambda _: None,
        "Status",
        camera={"quirks": {"overtriggered_time": 60}},
    ),
    Sin("reset-errors-brings-a-status", dropped(m.StatusReport), "nothing", "bid"),
    Sin("reset-errors-brings-a-status", replaced(m.ResetErrorsAnswer, code=0x10), "code=16", "bid"),
    Sin("trigger-error-stays-until-reset", without(Status.OVERTRIGGERED), "TriggerAnswer", "bid"),
    Sin("free-run-needs-no-trigger", _only_says_stopped, "ResultContainer", camera=FREE_RUNNING),
    Sin("stop-ends-run-mode", _no_stop, "the status stays 0x280"),
    Sin("second-stop-is-harmless", answers(m.Stop, _empty(0x42)), "id 0x42"),
    Sin("stopped-camera-ignores-triggers", hears(_result_when_stopped), "ResultContainer"),
    Sin("application-0-is-refused", replaced(m.SwitchAnswer, code=0), "code=0"),
    Sin("application-0-is-refused", replaced(m.SwitchAnswer, code=1), "code=1", "bid"),
    Sin("unknown-application-is-refused", replaced(m.SwitchAnswer, code=0), "code=0"),
    Sin("switch-loads-the-application", replaced(m.SwitchAnswer, application=9), "application=9"),
    Sin("busy-during-a-switch", without(Status.BUSY), "SwitchAnswer"),
    Sin("second-switch-meanwhile", doubled(m.SwitchAnswer), "SwitchAnswer"),
    Sin("second-switch-meanwhile", replaced(m.QueryAnswer, code=2), "code=2", "bid"),
    Sin("clock-is-reported", replaced(m.ClockAnswer, month=13), "month=13"),
    Sin("clock-is-set", deaf(m.SetClock), " 20"),
    Sin("impossible-date-is-harmless", hears(_keep_bad_date), "month=13"),
    Sin("impossible-date-is-harmless", replaced(m.SetClockAnswer, code=0), "code=0", "bid"),
    Sin("sequence-number-is-set", deaf(m.SetSequenceNumber), "00 00 00"),
    Sin("input-data-is-taken", deaf(m.SetInput), "Status"),
    Sin("unknown-id-is-ignored", _complain, "id 0x7f"),
    Sin("long-body-is-ignored", _complain, "10 00"),
    Sin("short-body-is-ignored", _complain, "10 00"),
    Sin("wrong-magic-is-ignored", takes(_any_magic), "QueryAnswer", transport="udp"),
    Sin("broken-datagram-is-ignored", takes(_any_datagram), "QueryAnswer", "b16", "udp"),
    Sin("reboot-restarts-the-camera", deaf(m.Reboot), "still answers"),
    Sin("stopped-after-a-reboot", _runs_after_boot, "application 5 runs"),
    Sin("only-documented-messages-came", hears(_unknown_answer), "0x44"),
)
"""Every check has one at least, but for silent-before-connect, which needs no emulator."""
