"""What a link proxy does to what passes it: small values, in one list.

A rule is for one direction, ``up`` from client to camera or ``down`` from camera to client, and for
one connection or for every one. On TCP there are two kinds of place:

- A *point* is reached as soon as ``at`` bytes have come from the sender: 0 is reached when the
  connection is made, a message's size right behind its last byte.
- A *range* begins with byte ``at``, counted from 0, and is ``count`` bytes long.

Offsets count what the sender sent, whatever other rules make of it. Rules at one place act in the
order of the list. On UDP a rule picks datagrams: one by its number, or each with a probability.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal, NamedTuple

from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from random import Random
    from typing import Self

__all__ = [
    "DIRECTIONS",
    "MAX_COPY",
    "MAX_HOLD",
    "Coalesce",
    "Cut",
    "DatagramRule",
    "Delay",
    "Direction",
    "Drip",
    "Drop",
    "Duplicate",
    "Flip",
    "Insert",
    "Late",
    "Lose",
    "Pace",
    "PointRule",
    "RangeRule",
    "Rate",
    "Reorder",
    "Repeat",
    "Reset",
    "Rule",
    "Span",
    "Split",
    "Stall",
    "StreamRule",
    "check_rules",
]

Direction = Literal["up", "down"]
"""``up`` is from client to camera."""

DIRECTIONS: tuple[Direction, Direction] = ("up", "down")

MAX_COPY = 1 << 20
"""Bytes that one rule may insert or duplicate: a proxy keeps them in memory."""

MAX_HOLD = 1 << 16
"""Bytes that one rule may hold back: fewer than the proxy keeps before it stops reading."""


@dataclass(frozen=True, kw_only=True)
class Rule:
    """What all rules have.

    Args:
        direction: which way it looks at.
        connection: number of the connection it is for, from 1; None is every one. On UDP each
            client address is a connection.
    """

    direction: Direction = "down"
    connection: int | None = None
    name: ClassVar[str]
    """The name in the proxy's log and counts."""

    def __init_subclass__(cls) -> None:
        cls.name = cls.__name__.lower()

    def __post_init__(self) -> None:
        _check(self, self.direction in DIRECTIONS, "direction must be 'up' or 'down'")
        _check(self, self.connection is None or self.connection >= 1, "connections count from 1")

    def concerns(self, connection: int, direction: Direction) -> bool:
        """Whether the rule is for this direction of this connection."""
        return self.direction == direction and self.connection in {None, connection}

    def ahead(self, by: int) -> Self:
        """Return the rule for a place so many bytes, or datagrams, later."""
        return self


def _check(rule: Rule, right: bool, text: str) -> None:
    if not right:
        raise ConfigurationError(f"{rule}: {text}")


def check_rules(rules: Sequence[Rule], kind: type[Rule], transport: str) -> None:
    """Refuse rules of the other transport.

    Raises:
        ConfigurationError: names the first one.
    """
    for rule in rules:
        _check(rule, isinstance(rule, kind), f"it means nothing on {transport.upper()}")


# ---------------------------------------------------------------------- TCP


class Span(NamedTuple):
    """Where a stream rule begins and ends; both are the same for a point, None is "never"."""

    begin: int
    end: int | None


class StreamRule(Rule):
    """A rule for TCP."""


@dataclass(frozen=True, kw_only=True)
class PointRule(StreamRule):
    """A rule that acts once, when ``at`` bytes have come."""

    at: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check(self, self.at >= 0, "at must be 0 or more bytes")

    @property
    def span(self) -> Span:
        """Its place."""
        return Span(self.at, self.at)

    def ahead(self, by: int) -> Self:
        """Return the rule for a place so many bytes later."""
        return replace(self, at=self.at + by)


@dataclass(frozen=True, kw_only=True)
class RangeRule(StreamRule):
    """A rule that acts on ``count`` bytes from byte ``at`` on; None is all of them."""

    at: int = 0
    count: int | None = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        _check(self, self.at >= 0, "at must be 0 or more bytes")
        _check(self, self.count is None or self.count >= 1, "count must be 1 or more bytes")

    @property
    def span(self) -> Span:
        """Its place."""
        return Span(self.at, None if self.count is None else self.at + self.count)

    def ahead(self, by: int) -> Self:
        """Return the rule for a place so many bytes later."""
        return replace(self, at=self.at + by)

    def change(self, data: bytes) -> bytes:
        """Return what becomes of bytes of the range."""
        return data


@dataclass(frozen=True, kw_only=True)
class Cut(PointRule):
    """End the connection in order: FIN to both sides, behind what has passed.

    What comes later is read and dropped, so that no reset overtakes the end.
    """


@dataclass(frozen=True, kw_only=True)
class Reset(PointRule):
    """End the connection hard: RST to both sides.

    It may overtake bytes that have passed and that the peer has not read.
    """


@dataclass(frozen=True, kw_only=True)
class Stall(PointRule):
    """Keep both sides open and pass nothing any more, until the proxy is told to resume.

    Args:
        both: stop the other direction too: a dead peer. Ends of the stalled sides are not noticed.
    """

    both: bool = False


@dataclass(frozen=True, kw_only=True)
class Split(PointRule):
    """Begin a new segment at ``at``.

    Args:
        pause: seconds before what follows is written. At 0 it is two turns of the event loop, and
            a receiver on the same loop gets both parts apart unless the system is slow to deliver;
            give it a pause where a test depends on that.
    """

    pause: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check(self, self.pause >= 0, "pause must be 0 or more seconds")


@dataclass(frozen=True, kw_only=True)
class Coalesce(PointRule):
    """Hold back what follows ``at`` and pass it in one write.

    Args:
        size: bytes to wait for; what came with them goes in the same write.
        seconds: the longest wait. The sender's end and a rule that acts in between end it too.
    """

    size: int
    seconds: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check(self, 1 <= self.size <= MAX_HOLD, f"size must be 1 to {MAX_HOLD} bytes")
        _check(self, self.seconds > 0, "seconds must be more than 0")


@dataclass(frozen=True, kw_only=True)
class Insert(PointRule):
    """Put bytes of the proxy's own in."""

    data: bytes

    def __post_init__(self) -> None:
        super().__post_init__()
        _check(self, 1 <= len(self.data) <= MAX_COPY, f"data must be 1 to {MAX_COPY} bytes")


@dataclass(frozen=True, kw_only=True)
class Flip(RangeRule):
    """Change bits.

    Args:
        mask: the bits of each byte that change, 1 to 255.
    """

    mask: int = 0xFF

    def __post_init__(self) -> None:
        super().__post_init__()
        _check(self, 1 <= self.mask <= 0xFF, "mask must be 1 to 255")

    def change(self, data: bytes) -> bytes:
        """Return the bytes with the bits changed."""
        return bytes(byte ^ self.mask for byte in data)


@dataclass(frozen=True, kw_only=True)
class Drop(RangeRule):
    """Leave a range out."""

    def change(self, data: bytes) -> bytes:
        """Return nothing."""
        return b""


@dataclass(frozen=True, kw_only=True)
class Duplicate(RangeRule):
    """Send a range again, right behind its end, as other rules left it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check(
            self,
            self.count is not None and self.count <= MAX_COPY,
            f"count must be at most {MAX_COPY} bytes",
        )


@dataclass(frozen=True, kw_only=True)
class Drip(RangeRule):
    """Write a range byte by byte.

    Args:
        pause: seconds between two writes; at 0 it is two turns of the event loop.
    """

    count: int | None = None
    pause: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check(self, self.pause >= 0, "pause must be 0 or more seconds")


class Pace(StreamRule):
    """A rule about time that holds for the whole connection."""


@dataclass(frozen=True, kw_only=True)
class Delay(Pace):
    """Pass everything later; the order stays, the end of the stream comes later too.

    Args:
        seconds: for everything.
        jitter: seconds; up to so much more, evenly spread, for each piece that comes.
        seed: of the jitter.
    """

    seconds: float
    jitter: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check(self, min(self.seconds, self.jitter) >= 0, "times must be 0 or more seconds")


@dataclass(frozen=True, kw_only=True)
class Rate(Pace):
    """Pass so many bytes a second and not more."""

    bytes_per_second: float

    def __post_init__(self) -> None:
        super().__post_init__()
        _check(self, self.bytes_per_second > 0, "the rate must be more than 0 bytes a second")


# ---------------------------------------------------------------------- UDP


@dataclass(frozen=True, kw_only=True)
class DatagramRule(Rule):
    """A rule for UDP.

    Args:
        number: of the datagram in its direction and connection, from 1; None lets the probability
            decide.
        probability: of each datagram, 0 to 1.
        seed: of the chance; the same seed picks the same datagrams.
    """

    number: int | None = None
    probability: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check(self, self.number is None or self.number >= 1, "datagrams count from 1")
        _check(self, 0 <= self.probability <= 1, "probability must be 0 to 1")

    def picks(self, number: int, chance: Random) -> bool:
        """Whether the rule acts on a datagram."""
        if self.number is None:
            return chance.random() < self.probability
        return number == self.number

    def ahead(self, by: int) -> Self:
        """Return the rule for a datagram so many later."""
        return self if self.number is None else replace(self, number=self.number + by)


@dataclass(frozen=True, kw_only=True)
class Lose(DatagramRule):
    """Let it vanish."""


@dataclass(frozen=True, kw_only=True)
class Repeat(DatagramRule):
    """Send it more than once.

    Args:
        copies: how many more.
    """

    copies: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        _check(self, 1 <= self.copies <= 100, "copies must be 1 to 100")


@dataclass(frozen=True, kw_only=True)
class Late(DatagramRule):
    """Send it later; others overtake it.

    Args:
        seconds: how much.
        jitter: seconds; up to so much more.
    """

    seconds: float
    jitter: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check(self, min(self.seconds, self.jitter) >= 0, "times must be 0 or more seconds")


@dataclass(frozen=True, kw_only=True)
class Reorder(DatagramRule):
    """Send it behind those that follow.

    Args:
        behind: how many of the same direction and connection overtake it.
        seconds: the longest wait for them.
    """

    behind: int = 1
    seconds: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check(self, self.behind >= 1, "behind must be 1 or more datagrams")
        _check(self, self.seconds > 0, "seconds must be more than 0")
