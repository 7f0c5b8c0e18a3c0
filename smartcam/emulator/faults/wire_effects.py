"""What faults make of one message on its way: parcels, to be passed on as they say. Pure."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from smartcam.emulator import faults as f
from smartcam.exceptions import FrameError
from smartcam.protocols.framed.framing import Frame, Framer

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from smartcam.protocols.framed.dialect import FramedDialect

__all__ = ["Cutter", "Ending", "Parcel", "cut_datagram", "mangle"]


class Ending(NamedTuple):
    """What becomes of a connection.

    Attributes:
        how: what happens.
        fault: kind of the fault behind it.
        seconds: how long a half-open connection stays; None: as long as it can.
    """

    how: Literal["close", "reset", "stall", "half_open"]
    fault: str
    seconds: float | None = None


@dataclass(slots=True, eq=False)
class Parcel:
    """A message, or something inserted, and how it passes.

    Attributes:
        what: the frame that its sender meant; bytes for what makes none.
        original: its bytes.
        parts: what is still to pass; each part is one write.
        pauses: seconds before each part but the first.
        delay: seconds before the first part.
        overtaken: whether later ones may pass it while it waits.
        gather: messages it waits for, and for how many seconds at most.
        end: what happens to the connection behind it.
        faults: kinds of the faults that acted on it.
        changeable: whether later faults act on it.
        passed: what has passed.
    """

    what: Frame | bytes
    original: bytes
    parts: list[bytes]
    pauses: list[float] = field(default_factory=list[float])
    delay: float = 0.0
    overtaken: bool = False
    gather: tuple[int, float] | None = None
    end: Ending | None = None
    faults: list[str] = field(default_factory=list[str])
    changeable: bool = True
    passed: bytearray = field(default_factory=bytearray)

    @classmethod
    def of(cls, what: Frame | bytes, data: bytes) -> Parcel:
        """Return a parcel that passes as it is."""
        return cls(what, data, [data])

    @property
    def size(self) -> int:
        """Bytes still to pass."""
        return sum(map(len, self.parts))

    @property
    def wire(self) -> bytes | None:
        """The bytes that passed, None where they are those that were meant."""
        return None if self.passed == self.original else bytes(self.passed)

    def place(self, offset: int) -> tuple[int, int]:
        """Return the part in which the byte at ``offset`` is, and where in it."""
        ends = list(accumulate(map(len, self.parts)))
        index = next(number for number, end in enumerate(ends) if offset < end)
        return index, offset - (ends[index] - len(self.parts[index]))

    def take(self) -> bytes:
        """Take the next part away."""
        return self.parts.pop(0) if self.parts else b""

    def drop(self) -> None:
        """Let nothing of it pass; no later fault acts on it."""
        self.parts, self.pauses, self.changeable = [], [], False

    def copy(self) -> Parcel:
        """Return another one like it."""
        return replace(
            self,
            parts=list(self.parts),
            pauses=list(self.pauses),
            faults=list(self.faults),
            passed=bytearray(),
        )


# ---------------------------------------------------------------------- each parcel of a message


def _delay(fault: f.Delay, parcel: Parcel) -> None:
    parcel.delay += fault.seconds
    parcel.overtaken |= fault.overtaken


def _split(fault: f.Split, parcel: Parcel) -> None:
    if fault.after >= parcel.size:
        return
    index, inner = parcel.place(fault.after)
    if inner:  # else it is cut there already
        part = parcel.parts[index]
        parcel.parts[index : index + 1] = [part[:inner], part[inner:]]
        parcel.pauses.insert(index, fault.pause)


def _coalesce(fault: f.Coalesce, parcel: Parcel) -> None:
    parcel.gather = (fault.count, fault.seconds)


def _truncate(fault: f.Truncate, parcel: Parcel) -> None:
    if fault.keep == 0:
        parcel.drop()
    elif fault.keep < parcel.size:
        index, inner = parcel.place(fault.keep - 1)
        parcel.parts[index:] = [parcel.parts[index][: inner + 1]]
        del parcel.pauses[index:]
    if fault.then != "continue":
        parcel.end = Ending(fault.then, fault.kind)


def _corrupt(fault: f.Corrupt, parcel: Parcel) -> None:
    size = parcel.size
    offset = fault.offset if fault.offset >= 0 else size + fault.offset
    if not 0 <= offset < size:
        return
    index, inner = parcel.place(offset)
    part = bytearray(parcel.parts[index])
    part[inner] = part[inner] ^ (fault.xor or 0) if fault.value is None else fault.value
    parcel.parts[index] = bytes(part)


def _drop(fault: f.Drop, parcel: Parcel) -> None:
    parcel.drop()


_CHANGES: Mapping[type[object], Callable[[Any, Parcel], None]] = {
    f.Delay: _delay,
    f.Split: _split,
    f.Coalesce: _coalesce,
    f.Truncate: _truncate,
    f.Corrupt: _corrupt,
    f.Drop: _drop,
}
"""Faults that act on each parcel of a message for itself."""


# ---------------------------------------------------------------------- all parcels of a message


def _duplicate(fault: f.Duplicate, parcels: list[Parcel], dialect: FramedDialect) -> list[Parcel]:
    result: list[Parcel] = []
    for parcel in parcels:
        result.append(parcel)
        if parcel.changeable:
            parcel.faults.append(fault.kind)
            result += [parcel.copy() for _ in range(fault.copies)]
    return result


def _insert(fault: f.Insert, parcels: list[Parcel], dialect: FramedDialect) -> list[Parcel]:
    places = [number for number, parcel in enumerate(parcels) if parcel.changeable]
    if not places:
        return parcels
    new = _inserted(fault, dialect)
    if fault.where == "before":
        return [*parcels[: places[0]], new, *parcels[places[0] :]]
    if fault.where == "after":
        return [*parcels[: places[-1] + 1], new, *parcels[places[-1] + 1 :]]
    new.changeable = True
    for place in places:
        parcels[place].drop()
        parcels[place].faults.append(fault.kind)
    return [*parcels[: places[-1] + 1], new, *parcels[places[-1] + 1 :]]


def _inserted(fault: f.Insert, dialect: FramedDialect) -> Parcel:
    word = fault.word
    data = dialect.encode(word) if word is not None else fault.data or b""
    parcel = cut_datagram(data, dialect)
    parcel.faults.append(fault.kind)
    parcel.changeable = False
    return parcel


def _end(
    fault: f.HalfOpen | f.Reset | f.Close,
    parcels: list[Parcel],
    dialect: FramedDialect,
) -> list[Parcel]:
    seconds = fault.seconds if isinstance(fault, f.HalfOpen) else None
    if fault.when == "before":
        for parcel in parcels:
            if parcel.changeable:
                parcel.drop()
                parcel.faults.append(fault.kind)
    parcels[-1].end = parcels[-1].end or Ending(fault.kind, fault.kind, seconds)
    return parcels


_REBUILDS: Mapping[type[object], Callable[[Any, list[Parcel], FramedDialect], list[Parcel]]] = {
    f.Duplicate: _duplicate,
    f.Insert: _insert,
    f.HalfOpen: _end,
    f.Reset: _end,
    f.Close: _end,
}
"""Faults that act on all parcels of a message together."""


def mangle(parcel: Parcel, faults: Sequence[f.Fault], dialect: FramedDialect) -> list[Parcel]:
    """Return what faults make of a message, in the order in which it passes.

    Args:
        parcel: the message.
        faults: wire faults, in the order in which they act.
        dialect: in which messages are inserted.
    """
    parcels = [parcel]
    for fault in faults:
        rebuild = _REBUILDS.get(type(fault))
        if rebuild is not None:
            parcels = rebuild(fault, parcels, dialect)
            continue
        for one in parcels:
            if one.changeable:
                one.faults.append(fault.kind)
                _CHANGES[type(fault)](fault, one)
    return parcels


class Cutter:
    """Cuts what a client sends into parcels: one for each whole frame, one for bytes between.

    Args:
        dialect: whose frames.
        max_length: largest payload accepted, bytes.
    """

    def __init__(self, dialect: FramedDialect, max_length: int) -> None:
        self._framer = Framer(dialect.header, max_length)
        self._dialect = dialect

    @property
    def pending(self) -> bytes:
        """Bytes of an unfinished frame."""
        return self._framer.pending

    def cut(self, data: bytes) -> list[Parcel]:
        """Return the parcels that are whole with these bytes; what is unfinished is kept."""
        framer = self._framer
        framer.feed(data)
        parcels: list[Parcel] = []
        while True:
            try:
                frame = framer.next_frame()
            except FrameError:
                before = framer.pending
                skipped = before[: framer.resync()]
                parcels.append(Parcel.of(skipped, skipped))
                continue
            if frame is None:
                return parcels
            parcels.append(Parcel.of(frame, self._dialect.encode_frame(frame)))


def cut_datagram(data: bytes, dialect: FramedDialect) -> Parcel:
    """Return a datagram as a parcel, with its frame if it is exactly one."""
    parcels = Cutter(dialect, len(data)).cut(data)
    return parcels[0] if [one.original for one in parcels] == [data] else Parcel.of(data, data)
