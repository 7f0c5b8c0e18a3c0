"""The rules of a link proxy: small values, in one list.

A rule is for one direction, ``up`` from client to camera or ``down`` from camera to client, and for
one connection or for every one. On TCP there are two kinds of rule:

- A *point* is reached as soon as ``at`` bytes have come from the sender: 0 is reached when the
  connection is made, a message's size right after its last byte.
- A *range* begins with byte ``at``, counted from 0, and is ``count`` bytes long.

Offsets count the sender's bytes, before the effects of other rules. Rules at one offset act in the
order of the list. On UDP a rule picks datagrams: one by its number, or each with a probability.

The emulator's :mod:`~smartcam.emulator.faults` act on messages; rules know none. If a fault has a
name like ``Drop``, the rule's name says what it drops: ``DropBytes``, ``DropDatagrams``.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeAlias

from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from random import Random
    from typing import Self

Direction = Literal["up", "down"]
"""``up`` is from client to camera."""

DIRECTIONS: tuple[Direction, Direction] = ("up", "down")

MAX_COPY_BYTES = 1 << 20
"""Largest number of bytes that one rule may insert or duplicate: the proxy keeps them in memory."""

MAX_RULE_BYTES = 1 << 16
"""Largest number of bytes that one rule may hold back: fewer than MAX_QUEUED_BYTES."""


_Bound: TypeAlias = "tuple[str, Callable[[Any], bool]]"
"""Text on the allowed values, and the function that returns True for a valid value."""

_BOUNDS: Mapping[str, _Bound] = {
    "direction": ("direction must be 'up' or 'down'", lambda direction: direction in DIRECTIONS),
    "connection": ("connections count from 1", lambda number: number is None or number >= 1),
    "at": ("at must be 0 or more bytes", lambda offset: offset >= 0),
    "count": ("count must be 1 or more bytes", lambda count: count is None or count >= 1),
    "size": (f"size must be 1 to {MAX_RULE_BYTES} bytes", lambda size: 1 <= size <= MAX_RULE_BYTES),
    "data": (
        f"data must be 1 to {MAX_COPY_BYTES} bytes",
        lambda data: 1 <= len(data) <= MAX_COPY_BYTES,
    ),
    "mask": ("mask must be 1 to 255", lambda mask: 1 <= mask <= 0xFF),
    "pause": ("pause must be 0 or more seconds", lambda seconds: seconds >= 0),
    "seconds": ("times must be 0 or more seconds", lambda seconds: seconds >= 0),
    "jitter": ("times must be 0 or more seconds", lambda seconds: seconds >= 0),
    "bytes_per_second": ("the rate must be more than 0 bytes a second", lambda rate: rate > 0),
    "number": ("datagrams count from 1", lambda number: number is None or number >= 1),
    "probability": ("probability must be 0 to 1", lambda share: 0 <= share <= 1),
    "copies": ("copies must be 1 to 100", lambda copies: 1 <= copies <= 100),
    "overtaken_by": ("overtaken_by must be 1 or more datagrams", lambda count: count >= 1),
}
"""Bounds of a rule's fields."""

_POSITIVE: Mapping[str, _Bound] = {
    **_BOUNDS,
    "seconds": ("seconds must be more than 0", lambda seconds: seconds > 0),
}


@dataclass(frozen=True, kw_only=True)
class Rule:
    """Base of all rules.

    Args:
        direction: direction of the data that the rule applies to.
        connection: number of the connection that the rule is for, from 1; None is every one. On
            UDP each client address is a connection.
    """

    direction: Direction = "down"
    connection: int | None = None
    name: ClassVar[str]
    """The name in the proxy's log and counts."""
    _bounds: ClassVar[Mapping[str, _Bound]] = _BOUNDS

    def __init_subclass__(cls, name: str = "") -> None:
        cls.name = name or cls.__name__.lower()

    def __post_init__(self) -> None:
        for field in fields(self):
            if field.name in self._bounds:
                text, is_valid = self._bounds[field.name]
                _require(self, is_valid(getattr(self, field.name)), text)

    def concerns(self, connection: int, direction: Direction) -> bool:
        """Return True if the rule is for this direction of this connection."""
        return self.direction == direction and self.connection in {None, connection}

    def moved_later(self, by: int) -> Self:
        """Return a copy of the rule that acts ``by`` bytes, or datagrams, later."""
        return self


def _require(rule: Rule, is_valid: bool, text: str) -> None:
    if not is_valid:
        raise ConfigurationError(f"{rule}: {text}")


def check_rules(rules: Sequence[Rule], kind: type[Rule], transport: str) -> None:
    """Check that all rules are for one transport.

    Raises:
        ConfigurationError: a rule is for the other transport; the text names the first one.
    """
    for rule in rules:
        _require(rule, isinstance(rule, kind), f"it means nothing on {transport.upper()}")


# ---------------------------------------------------------------------- TCP


class StreamRule(Rule):
    """A rule for TCP."""


@dataclass(frozen=True, kw_only=True)
class PlacedRule(StreamRule):
    """A rule for a point in the stream, ``at`` bytes from its beginning."""

    at: int = 0

    def moved_later(self, by: int) -> Self:
        """Return a copy of the rule that acts ``by`` bytes later."""
        return replace(self, at=self.at + by)


class PointRule(PlacedRule):
    """A rule that acts once, when ``at`` bytes have come."""


@dataclass(frozen=True, kw_only=True)
class RangeRule(PlacedRule):
    """A rule that acts on ``count`` bytes from byte ``at`` on; None is all of them."""

    count: int | None = 1

    @property
    def end(self) -> int | None:
        """Offset after the range's last byte, None for a range without an end."""
        return None if self.count is None else self.at + self.count

    def change(self, data: bytes) -> bytes:
        """Return the bytes that the proxy sends for these bytes of the range."""
        return data


class Cut(PointRule):
    """Close the connection normally: FIN to both sides, after the bytes that have passed.

    Later bytes are read and dropped, so that no reset overtakes the end.
    """


class ResetConnection(PointRule, name="reset"):
    """End the connection hard: RST to both sides.

    It may overtake bytes that have passed and that the peer has not read.
    """


@dataclass(frozen=True, kw_only=True)
class Stall(PointRule):
    """Keep both sides open and pass nothing any more, until ``resume`` is called.

    Args:
        both: stop the other direction, too, like a dead peer. That a stalled side closes its
            connection is not noticed.
    """

    both: bool = False


@dataclass(frozen=True, kw_only=True)
class SplitBytes(PointRule, name="split"):
    """Begin a new segment at ``at``.

    Args:
        pause: seconds before the following bytes are written. At 0 the pause is two turns of the
            event loop; a receiver on the same loop gets both parts separately unless the system is
            slow. Use a pause in a test that depends on that.
    """

    pause: float = 0.0


@dataclass(frozen=True, kw_only=True)
class CoalesceBytes(PointRule, name="coalesce"):
    """Hold back the bytes after ``at`` and pass them in one write.

    Args:
        size: bytes to wait for; bytes that came with them are in the same write.
        seconds: the longest wait. The sender's FIN, or another rule that acts, ends it earlier.
    """

    size: int
    seconds: float = 1.0
    _bounds: ClassVar[Mapping[str, _Bound]] = _POSITIVE


@dataclass(frozen=True, kw_only=True)
class InsertBytes(PointRule, name="insert"):
    """Insert bytes that neither side sent."""

    data: bytes


@dataclass(frozen=True, kw_only=True)
class Flip(RangeRule):
    """Change bits.

    Args:
        mask: the bits of each byte that change, 1 to 255.
    """

    mask: int = 0xFF

    def change(self, data: bytes) -> bytes:
        """Return the bytes with the bits changed."""
        return bytes(byte ^ self.mask for byte in data)


class DropBytes(RangeRule, name="drop"):
    """Drop the bytes of a range."""

    def change(self, data: bytes) -> bytes:
        """Return nothing."""
        return b""


class DuplicateBytes(RangeRule, name="duplicate"):
    """Send a range again, right after its end, as other rules left it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _require(
            self,
            self.count is not None and self.count <= MAX_COPY_BYTES,
            f"count must be at most {MAX_COPY_BYTES} bytes",
        )


@dataclass(frozen=True, kw_only=True)
class Drip(RangeRule):
    """Write a range byte by byte.

    Args:
        pause: seconds between two writes; at 0 it is two turns of the event loop.
    """

    count: int | None = None
    pause: float = 0.0


class Pace(StreamRule):
    """A rule about time for the whole connection."""


@dataclass(frozen=True, kw_only=True)
class DelayBytes(Pace, name="delay"):
    """Pass everything later; the order stays, and the end of the stream comes later, too.

    Args:
        seconds: delay of everything.
        jitter: seconds; largest additional delay, evenly distributed, for each received piece.
        seed: seed of the jitter.
    """

    seconds: float
    jitter: float = 0.0
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class Rate(Pace):
    """Pass at most so many bytes per second."""

    bytes_per_second: float


# ---------------------------------------------------------------------- UDP


@dataclass(frozen=True, kw_only=True)
class DatagramRule(Rule):
    """A rule for UDP.

    Args:
        number: number of the datagram in its direction and connection, from 1; None lets the
            probability decide.
        probability: probability for each datagram, 0 to 1.
        seed: seed of the random numbers; the same seed picks the same datagrams.
    """

    number: int | None = None
    probability: float = 1.0
    seed: int = 0

    def picks(self, number: int, chance: Random) -> bool:
        """Return True if the rule acts on a datagram."""
        if self.number is None:
            return chance.random() < self.probability
        return number == self.number

    def moved_later(self, by: int) -> Self:
        """Return the rule for the datagram that comes ``by`` datagrams later."""
        return self if self.number is None else replace(self, number=self.number + by)


class DropDatagrams(DatagramRule, name="drop"):
    """Drop the datagram."""


@dataclass(frozen=True, kw_only=True)
class DuplicateDatagrams(DatagramRule, name="duplicate"):
    """Send the datagram more than once.

    Args:
        copies: number of additional copies.
    """

    copies: int = 1


@dataclass(frozen=True, kw_only=True)
class DelayDatagrams(DatagramRule, name="delay"):
    """Send the datagram later; others overtake it.

    Args:
        seconds: delay of the datagram.
        jitter: seconds; largest additional delay.
    """

    seconds: float
    jitter: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Reorder(DatagramRule):
    """Send the datagram after the datagrams that follow it.

    Args:
        overtaken_by: number of datagrams of the same direction and connection that overtake it.
        seconds: the longest wait for them.
    """

    overtaken_by: int = 1
    seconds: float = 1.0
    _bounds: ClassVar[Mapping[str, _Bound]] = _POSITIVE
