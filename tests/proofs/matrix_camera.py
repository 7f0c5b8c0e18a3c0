"""Cells of the fault matrix whose fault is the camera's: its frames, its answers, its life."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

from smartcam import exceptions as e
from smartcam.emulator import faults as f
from smartcam.emulator._inside import MESSAGE_NAMES
from smartcam.models import Status
from smartcam.protocols._inside import ResultCode
from tests.proofs.books import TRIGGER_OUTCOMES
from tests.proofs.matrix_cells import (
    AT_ONCE,
    LOST,
    NONE,
    OPS,
    REFUSED,
    SILENT,
    TWICE,
    Cell,
    Errors,
    Fault,
    Place,
)
from tests.proofs.matrix_world import AWAY, HOME, PATIENT, SHORT, STRAY, Bench, World

UNREAD: Errors = (e.InterpretationError,)
DENIED: Errors = (e.CommandRejectedError,)

UNKNOWN_ID = 0x77
NO_APPLICATION = 99
GARBAGE = bytes.fromhex("000102 80feff 0d")
MAX_LENGTH = 1 << 20
"""The client's limit, by default."""

MISTAKES = (
    ResultCode.ERROR,
    ResultCode.INVALID_COMMAND,
    ResultCode.BUSY,
    ResultCode.INSPECTION_ERROR,
    0x55,
)
"""Codes that say that something was not done; the last one has no meaning."""

ANSWERS: Mapping[str, Mapping[str, int | str]] = {
    "ConnectAnswer": {"version": 1},
    "QueryAnswer": {"application": AWAY},
    "SwitchAnswer": {"code": 0, "application": AWAY},
    "ClockAnswer": {"year": 1999, "month": 1, "day": 1, "hour": 1, "minute": 1, "second": 1},
    "TriggerAnswer": {},
    "SetClockAnswer": {},
    "SetInputAnswer": {},
    "ResetErrorsAnswer": {},
    "DisconnectAnswer": {},
}
"""Answers, with what would be wrong values; codes say that all is well."""

LIES = frozenset({"QueryAnswer", "ClockAnswer"})
"""Those that are believed if they come while their request is open: nothing tells them from the
true one, which comes behind them."""


def by_camera(given: Sequence[f.Fault], allowed: Errors = SILENT, **more: Any) -> Fault:
    """Return what faults of the emulated camera do."""

    def arm(bench: Bench) -> None:
        bench.box.inject(*given)

    def fired(bench: Bench) -> bool:
        happened = [one.fault for one in bench.box.fired]
        return all(one in happened for one in given)

    return Fault(arm, fired, allowed, **more)


# ---------------------------------------------------------------------- frames


def _length(
    world: World, place: Place, change: int | None, value: int | None = None
) -> list[f.Fault]:
    """Return what writes another length into a frame's header."""
    at, size = _length_at(world), world.word
    length = value if value is not None else _told(world, place) + (change or 0)
    return [
        f.Corrupt(**_on(place), offset=at + index, value=byte)
        for index, byte in enumerate(length.to_bytes(size, "little"))
    ]


def _told(world: World, place: Place) -> int:
    """Return the length that a frame's header tells."""
    at = _length_at(world)
    return int.from_bytes(place.frame.wire[at : at + world.word], "little")


def _length_at(world: World) -> int:
    header = world.spoken.header
    return len(header.magic) + (world.word if header.id_first else 0)


def _id_at(world: World) -> int:
    header = world.spoken.header
    return len(header.magic) + (0 if header.id_first else world.word)


def _on(place: Place) -> dict[str, Any]:
    return {"on": place.frame.message, "nth": place.number}


WITHHELD = frozenset(
    {"dropped", "unknown id", "short body"}
    | {f"{what} instead" for what in ("status", "warm status", "container", "foreign container")}
    | {f"{what} instead" for what in ANSWERS}
)
"""Deeds that withhold a status if they are done to one."""

EVIDENCE = frozenset({"QueryAnswer", "StatusReport"})
"""Messages that show that the camera took a trigger, where its status has to be asked for."""

CONFUSES = WITHHELD | {"TriggerAnswer before", "TriggerAnswer after"}
"""Deeds done to evidence so that nobody can tell whose a result is."""

ASKS_EVIDENCE = frozenset({"Query", "GetStatus"})
"""Questions whose answers are evidence; one that the camera does not hear withholds it."""


class _Mangling(NamedTuple):
    """A deed done to a frame of the camera."""

    name: str
    faults: list[f.Fault]
    allowed: Errors = SILENT
    harmless: bool = False
    copies: int = 1
    strays: bool = False
    garbled: bool = False


def _broken(world: World, place: Place) -> Iterator[_Mangling]:
    """Frames that are none, or not the one they say they are."""
    on, header, word = _on(place), world.header, world.word
    container = place.frame.message == "ResultContainer"
    unread = UNREAD if container else NONE
    any_error: dict[str, Any] = {"allowed": (*TRIGGER_OUTCOMES, *SILENT, *DENIED), "garbled": True}
    # without a magic number a wrong length shows by nothing but what is missing afterwards, and
    # what is read instead may refuse the session
    shown = {} if world.has_magic else any_error
    any_error["allowed"] += () if world.has_magic else (e.ConnectFailedError,)
    for offset in range(len(world.spoken.header.magic)):
        yield _Mangling(f"magic {offset}", [f.Corrupt(**on, offset=offset, xor=0x20)])
    for change in (-word, -1, 1, word, 100):
        yield _Mangling(f"length {change:+}", _length(world, place, change), **any_error)
    lengths = {"0": 0, "bomb": (1 << 8 * word) - 1}
    if world.has_magic:
        lengths["over the limit"] = MAX_LENGTH + 1 + (place.size - header < _told(world, place)) * 4
    for name, value in lengths.items():
        yield _Mangling(f"length {name}", _length(world, place, None, value), **shown)
    yield _Mangling("unknown id", [f.Corrupt(**on, offset=_id_at(world), value=UNKNOWN_ID)])
    short = f.Truncate(**on, keep=place.size - word, then="continue")
    yield _Mangling("short body", [short, *_length(world, place, -word)], (*SILENT, *unread))
    longer = f.Insert(**on, data=bytes(word), where="after")
    # four bytes are the answer to Connect of b16 with the quirk "code", and say no
    taken = place.frame.message == "ConnectAnswer" and not world.has_magic
    allowed: Errors = (*unread, e.ConnectFailedError) if taken else unread
    yield _Mangling("long body", [*_length(world, place, word), longer], allowed, harmless=True)
    for keep in (1, header - 1, header, place.size - 1):
        cut = f.Truncate(**on, keep=keep, then="continue")
        yield _Mangling(f"only {keep} bytes", [cut], **any_error)
    for where in ("before", "after"):
        for name, data in (("garbage", GARBAGE), ("half a frame", place.frame.wire[:header])):
            noise = f.Insert(**on, data=data, where=where)
            yield _Mangling(f"{name} {where}", [noise], **any_error)


def _wrong_words(world: World, place: Place) -> Iterator[_Mangling]:
    """Whole frames that should not come, or not now."""
    on = _on(place)
    name = place.frame.message
    yield _Mangling("dropped", [f.Drop(**on)])
    twice = f.Duplicate(**on)
    yield _Mangling("twice", [twice], NONE, harmless=True, copies=2)
    yield _Mangling("soon", [f.Delay(**on, seconds=0.02)], NONE, harmless=True)
    yield _Mangling("late", [f.Delay(**on, seconds=0.25)])
    for other, fields in _answers_of(world).items():
        if other != name:
            wrong = f.Insert(**on, message=other, fields=dict(fields), where="instead")
            # while a switch is open, a SwitchAnswer is an answer to it, and not the right one
            answers = other == "SwitchAnswer"
            denied = (*SILENT, *DENIED) if answers else SILENT
            lie = other in LIES and other in place.owed
            denied = (*denied, *DENIED, e.WrongApplicationError) if lie else denied
            yield _Mangling(f"{other} instead", [wrong], denied, garbled=lie)
            for where in ("before", "after"):
                more = f.Insert(**on, message=other, fields=dict(fields), where=where)
                allowed = denied if answers or lie else NONE
                harmless = not (answers or lie)
                yield _Mangling(f"{other} {where}", [more], allowed, harmless, garbled=lie)
    yield from _refusals(world, place)
    yield from _stray_statuses(world, place)
    yield from _stray_containers(place)


def _answers_of(world: World) -> dict[str, Mapping[str, int | str]]:
    spoken = world.spoken
    return {name: one for name, one in ANSWERS.items() if spoken.has(MESSAGE_NAMES[name])}


def _refusals(world: World, place: Place) -> Iterator[_Mangling]:
    """Answers that say that nothing was done, where there are codes for that."""
    name = place.frame.message
    fields = ANSWERS.get(name)
    if fields is None or not world.spoken.capabilities.result_codes:
        return
    for code in MISTAKES:
        no = f.Insert(
            **_on(place), message=name, fields={**fields, "code": int(code)}, where="instead"
        )
        allowed = (*SILENT, *REFUSED)
        allowed += (e.ConnectFailedError,) if name == "ConnectAnswer" else ()
        yield _Mangling(f"code {code:#04x}", [no], allowed, garbled=name in LIES)


def _stray_statuses(world: World, place: Place) -> Iterator[_Mangling]:
    on, header = _on(place), world.header
    # what is said is true, but need not be said
    after = place.status
    if place.frame.message == "StatusReport":
        told = int.from_bytes(place.frame.wire[header : header + world.word], "little")
        after = world.spoken.status_bits.read(told)
    where: Literal["before", "after", "instead"]
    for where, status in (("before", place.status), ("after", after), ("instead", place.status)):
        for name, bits in (("status", status), ("warm status", status | Status.OVERHEAT)):
            stray = f.Insert(
                **on, message="StatusReport", fields={"status": int(bits)}, where=where
            )
            instead = where == "instead"
            allowed = SILENT if instead else NONE
            yield _Mangling(f"{name} {where}", [stray], allowed, harmless=not instead)


def _stray_containers(place: Place) -> Iterator[_Mangling]:
    on = _on(place)
    where: Literal["before", "after", "instead"]
    for where in ("before", "after", "instead"):
        for name, application in (("container", HOME), ("foreign container", NO_APPLICATION)):
            data = b"".join(one.to_bytes(4, "little", signed=True) for one in (5, STRAY, 0, 1))
            stray = f.Insert(
                **on,
                message="ResultContainer",
                fields={"application": application, "data": data.hex()},
                where=where,
            )
            # the next trigger may come too soon: the camera is still at work
            allowed: Errors = (e.WrongApplicationError, e.OvertriggeredError)
            if where == "instead":
                allowed = (*SILENT, *allowed)
            yield _Mangling(
                f"{name} {where}", [stray], allowed, harmless=where != "instead", strays=True
            )


def frame_cells(world: World, name: str, found: Sequence[Place]) -> Iterator[Cell]:
    """Give what can be wrong with what the camera says."""
    for place in found:
        if place.way == "up":
            continue
        families = {"frame": _broken(world, place), "word": _wrong_words(world, place)}
        for family, manglings in families.items():
            for one in manglings:
                if one.name in {"soon", "late"} and world.transport == "udp":
                    continue  # there others overtake it: the cells of the link have it
                # a datagram is a frame or nothing: what is broken is lost
                lost = world.transport == "udp" and family == "frame"
                status = place.frame.message == "StatusReport"
                allowed = (*SILENT, *one.allowed) if lost else one.allowed
                if world.is_asked and place.frame.message in EVIDENCE and one.name in CONFUSES:
                    allowed = (*allowed, e.OvertriggeredError)  # it cannot be told whose it is
                fault = by_camera(
                    one.faults,
                    allowed,
                    bounds=PATIENT if one.harmless and not lost else SHORT,
                    copies=one.copies,
                    strays=one.strays and not world.numbered,
                    garbled=one.garbled,
                    blind=world.transport == "tcp"
                    and not world.is_asked
                    and (one.garbled or (status and one.name in WITHHELD)),
                )
                yield Cell(
                    f"{world.transport} {family}", world, name, f"{place.name}: {one.name}", fault
                )


def request_cells(world: World, name: str, found: Sequence[Place]) -> Iterator[Cell]:
    """Give what can become of what the client says before the camera hears it."""
    udp = world.transport == "udp"
    coded = world.spoken.capabilities.result_codes
    wrong_length = (*SILENT, *DENIED) if coded else SILENT
    for place in found:
        if place.way == "down":
            continue
        on = _on(place)
        asked: dict[str, tuple[list[f.Fault], Errors, bool]] = {
            "dropped": ([f.Drop(**on)], SILENT, False),
            "twice": ([f.Duplicate(**on)], TWICE.get(place.frame.message, NONE), True),
            # a datagram alone is late, and others overtake it
            "soon": ([f.Delay(**on, seconds=0.02)], SILENT if udp else NONE, not udp),
            "late": ([f.Delay(**on, seconds=0.25)], SILENT, False),
            "unknown id": (
                [f.Corrupt(**on, offset=_id_at(world), value=UNKNOWN_ID)],
                SILENT,
                False,
            ),
            "length +1": (_length(world, place, 1), wrong_length, False),
            "length bomb": (_length(world, place, None, (1 << 8 * world.word) - 1), SILENT, False),
        }
        if world.has_magic:
            asked["magic"] = ([f.Corrupt(**on, offset=1, xor=0x20)], SILENT, False)
        if place.size > world.header:
            flipped = f.Corrupt(**on, offset=world.header, xor=0x40)
            asked["other body"] = ([flipped], (*SILENT, *DENIED), False)
        for label, (faults, allowed, harmless) in asked.items():
            # what breaks one frame may cost the next, and then an inspection has no input
            starved = (e.InputContainerError,) if name == "input" and not harmless else NONE
            if world.is_asked and place.frame.message in ASKS_EVIDENCE and label in WITHHELD:
                allowed = (*allowed, e.OvertriggeredError)  # it cannot be told whose it is
            held = sum(one.seconds for one in faults if isinstance(one, f.Delay)) if udp else 0.0
            fault = by_camera(
                faults,
                (*allowed, *starved),
                bounds=PATIENT if harmless else SHORT,
                lasts=held,
                garbled=label == "other body",
            )
            yield Cell(f"{world.transport} request", world, name, f"{place.name}: {label}", fault)


# ---------------------------------------------------------------------- the device


def _end_faults(bench: Bench) -> None:
    bench.box.clear_faults()
    bench.box.device.set_condition(Status.SYSTEM_ERROR, on=False)
    if bench.world.spoken.status_bits.always & Status.RUNNING:  # no client can start it
        bench.box.device.start()


STOPPED: Errors = (e.NotRunningError,)
MEDDLED: Errors = (*STOPPED, e.WrongApplicationError)


def device_cells(world: World, name: str, found: Sequence[Place]) -> Iterator[Cell]:
    """Give what can happen to the camera while the client speaks to it."""
    for place in found:
        if place.frame.message == "Disconnect" and not OPS[name].opened:
            continue  # without a session the camera takes no notice of it
        if place.way == "down":
            on: dict[str, Any] = _on(place)
            yield from _life_cells(world, name, place, {**on, "when": "before"})
            continue
        for when in ("before", "after"):
            on = {**_on(place), "when": when}
            yield from _life_cells(world, name, place, on)
            yield from _operator_cells(world, name, place, on)
        if place.frame.message == "Trigger":
            yield from _run_cells(world, name, place)


def _life_cells(world: World, name: str, place: Place, on: dict[str, Any]) -> Iterator[Cell]:
    """Give what ends the session: a reboot, another client, a refusal."""
    lost: dict[str, Any] = {"bounds": PATIENT, "at_once": AT_ONCE}
    allowed: Errors = (*LOST, e.ConnectFailedError)
    if world.transport == "udp":  # nobody tells
        lost, allowed = {"bounds": SHORT}, (*SILENT, e.ConnectFailedError)
    label = f"{place.name} {on['when']}: "
    reboot = by_camera([f.PowerCycle(**on, seconds=0.05)], allowed, **lost)
    yield Cell(f"{world.transport} reboot", world, name, label + "reboot", reboot)
    other = by_camera([f.SecondClient(**on)], allowed, **lost)
    yield Cell(f"{world.transport} second client", world, name, label + "second client", other)
    # behind a request: in place of it the camera would not hear it
    ending = f.Reset(**{**on, "when": "before" if place.way == "down" else "after"})
    refused = by_camera([f.Refuse(**on, seconds=0.15), ending], allowed, **lost)
    yield Cell(f"{world.transport} refused", world, name, label + "refused", refused)


def _operator_cells(world: World, name: str, place: Place, on: dict[str, Any]) -> Iterator[Cell]:
    label = f"{place.name} {on['when']}: "
    busy = by_camera([f.BusyForEver(**on)], SILENT, heal=_end_faults)
    yield Cell(f"{world.transport} busy", world, name, label + "busy for ever", busy)
    meddling: dict[str, tuple[f.Fault, Errors, Errors]] = {
        "stop": (f.OperatorStop(**on), SILENT, STOPPED),
        "start": (f.OperatorStart(**on), (*SILENT, *DENIED), NONE),
        "switch": (f.OperatorSwitch(**on, application=AWAY), (*SILENT, *DENIED), MEDDLED),
        "switch and run": (
            f.OperatorSwitch(**on, application=AWAY, running=True),
            (*SILENT, *DENIED),
            MEDDLED,
        ),
        "system error": (
            f.Condition(**on, condition="system_error"),
            (*SILENT, e.CameraFaultError),
            NONE,
        ),
    }
    for what, (one, allowed, repairs) in meddling.items():
        fault = by_camera([one], allowed, repairs=repairs, heal=_end_faults)
        yield Cell(f"{world.transport} operator", world, name, label + what, fault)
        if world.transport == "udp" and name == "query" and what != "system error":
            # the client has nothing to do, and does not hear of it
            unheard = [one, *(f.Drop(on="StatusReport", nth=number) for number in (1, 2, 3))]
            heal = _end_faults if world.is_asked else None
            fault = by_camera(unheard, allowed, repairs=repairs, heal=heal)
            yield Cell("udp operator", world, name, f"{label}{what}, unheard", fault)


def _run_cells(world: World, name: str, place: Place) -> Iterator[Cell]:
    """Give what can happen to an inspection."""
    on = _on(place)
    odd: dict[str, tuple[f.Fault, Errors, bool]] = {
        "overtriggered": (f.Overtrigger(**on), (e.OvertriggeredError,), True),
        "a little late": (f.LateResult(**on, seconds=0.05), NONE, True),
        "late": (f.LateResult(**on, seconds=0.45), SILENT, False),
        "later": (f.LateResult(**on, seconds=0.9), SILENT, False),
        "no result": (f.NoResult(**on), SILENT, False),
        "2 results": (f.ExtraResult(**on, count=1), NONE, True),
        "4 results": (f.ExtraResult(**on, count=3), NONE, True),
    }
    for what, (one, allowed, harmless) in odd.items():
        fault = by_camera([one], allowed, bounds=PATIENT if harmless else SHORT, heal=_end_faults)
        yield Cell(f"{world.transport} run", world, name, f"{place.name}: {what}", fault)
    if name in {"trigger", "input"}:
        # it comes when the next trigger is under way. That the camera says all in order is what
        # holds without a number; over UDP that is nobody's to say
        late = f.Delay(
            on="ResultContainer", nth=place.number, seconds=0.13, overtaken=world.numbered
        )
        slow = f.LateResult(on="Trigger", nth=place.number + 1, seconds=0.07)
        fault = by_camera(
            [late, slow],
            SILENT,
            bounds=SHORT._replace(trigger=0.1),
            strays=world.transport == "udp" and not world.numbered,
        )
        yield Cell(f"{world.transport} run", world, name, f"{place.name}: overtaken", fault)
