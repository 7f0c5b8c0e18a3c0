"""A recorded camera that spoke in lines, emulated: each line gets what the recorded one got.

The n-th time that a client says a line, it gets what the n-th one got, byte for byte and after the
same time; behind the last of them the last one again. A trigger behind the last one gets nothing.
A line that was never said ends the connection: nobody knows its answer.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.emulator._line_camera import LineCamera, LineClient
from smartcam.exceptions import ConfigurationError, RecordingError
from smartcam.models import Disconnected
from smartcam.observers import TraceEntry
from smartcam.protocols import messages as m
from smartcam.protocols._base import load_protocol
from smartcam.recording._schedule import MAX_REPLAY
from smartcam.settings import parse_address

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from smartcam.emulator._client_link import ClientLink
    from smartcam.emulator._line_codec import LineCodec
    from smartcam.protocols._base import Protocol
    from smartcam.recording._form import Item
    from smartcam.recording._reader import Recording


class TimedLine(NamedTuple):
    """Bytes that the camera said, so many seconds after what they answer."""

    seconds: float
    data: bytes


@dataclass(slots=True)
class LineAnswers:
    """What a line got, each time that it was said."""

    given: list[list[TimedLine]] = field(default_factory=list[list[TimedLine]])
    next: int = 0

    @property
    def left(self) -> int:
        """How many were not played yet, in this round."""
        return max(0, len(self.given) - self.next)

    def forget_silence(self) -> None:
        """The link ended: what a line under way would have got is not known."""
        if self.given and not self.given[-1]:
            self.given.pop()

    def take(self, *, loop: bool) -> list[TimedLine]:
        """Return the next ones; behind the last the last again, or the first."""
        if loop and self.next >= len(self.given):
            self.next = 0
        found = self.given[min(self.next, len(self.given) - 1)]
        self.next += 1
        return found


@dataclass(slots=True)
class LinesPlan:
    """What a recorded camera said.

    Attributes:
        greeting: before any line was said.
        answers: to each line, without its end.
        secrets: to a line that was not recorded, such as a password, by its place in a session.
    """

    greeting: list[TimedLine] = field(default_factory=list[TimedLine])
    answers: dict[bytes, LineAnswers] = field(default_factory=dict[bytes, LineAnswers])
    secrets: dict[int, LineAnswers] = field(default_factory=dict[int, LineAnswers])


def plan_lines(items: Iterable[Item], cut: Callable[[bytes], bytes]) -> LinesPlan:
    """Work out what each line got; ``cut`` returns a line without its end.

    Raises:
        RecordingError: it is more than :data:`MAX_REPLAY`.
    """
    plan = LinesPlan()
    pieces, began, place, size = plan.greeting, None, 0, 0
    last = LineAnswers()
    for item in items:
        if isinstance(item, Disconnected):
            last.forget_silence()
            pieces, began, place = [], None, 0
        if not isinstance(item, TraceEntry) or item.direction == "!":
            continue
        at, data = item.at.timestamp(), bytes.fromhex(item.hex)
        size += len(data)
        if size > MAX_REPLAY:
            raise RecordingError(f"recording: {size} bytes of lines, expected {MAX_REPLAY} at most")
        began = at if began is None else began
        if item.direction == "<":
            pieces.append(TimedLine(max(0.0, at - began), data))
            continue
        pieces, began = [], at
        last = (
            plan.answers.setdefault(cut(data), LineAnswers())
            if data
            else plan.secrets.setdefault(place, LineAnswers())
        )
        last.given.append(pieces)
        place += 1
    last.forget_silence()
    plan.answers = {line: one for line, one in plan.answers.items() if one.given}
    return plan


class ReplayedLines(LineCamera):
    """An emulated camera that plays what a camera of lines said; see :func:`replay`."""

    def __init__(
        self,
        kind: type[LineCamera],
        recording: Recording,
        *,
        camera: str | None = None,
        speed: float = 1.0,
        loop: bool = False,
        on_over: Callable[[], None] | None = None,
        **options: Any,
    ) -> None:
        known = recording.camera(camera)
        self._kind = kind
        self._address = parse_address(known.url)
        self.protocol: Protocol = load_protocol(known.protocol)
        self.max_links: int = kind.max_links
        self.write_limit: int = kind.write_limit
        super().__init__(**{"name": known.name, **options})
        if recording.since is not None:
            raise ConfigurationError(
                f"recording {recording.path}: camera {known.name!r} speaks in lines, which are "
                "played from the begin, not from a time on"
            )
        self.plan: LinesPlan = plan_lines(recording.items(known.name), self._bare)
        if not self.plan.answers:
            raise ConfigurationError(
                f"recording {recording.path}: no line to camera {known.name!r} is in it"
            )
        self._speed, self._loop = speed, loop
        self._on_over = None if loop else on_over
        self._places: dict[LineClient, int] = {}

    def make_codec(self) -> LineCodec:
        """Return the lines of the recorded camera."""
        return self._kind.make_codec(self)

    def _bare(self, data: bytes) -> bytes:
        return self.lines.text(data).encode(self.lines.encoding, "replace")

    @property
    def url(self) -> str:
        """Its address, with what the recorded one says beside host and port."""
        return self._address._replace(host=self.host, port=self.port).url

    @property
    def remaining(self) -> int:
        """How many triggers are left, in this round."""
        return sum(one.left for line, one in self.plan.answers.items() if self._triggers(line))

    def _triggers(self, line: bytes) -> bool:
        row = self.lines.row_of(line.decode(self.lines.encoding, "replace"))
        return self.lines.message_type(m.Sender.CLIENT, row) is m.Trigger

    def greet(self, client: LineClient) -> None:
        """Say what came before any line."""
        self._places[client] = 0
        if 0 in self.plan.secrets:
            client.hide_next()
        self._play(client, self.plan.greeting)

    def hear(self, client: LineClient, line: str) -> None:
        """Give a line what the recorded one got."""
        place = self._places[client]
        self._places[client] += 1
        data = line.encode(self.lines.encoding, "replace")
        found = self.plan.secrets.get(place) or self.plan.answers.get(data)
        if found is None:
            client.end(f"nothing in the recording answers {line[:64]!r}")
            return
        triggers = self._triggers(data)
        if triggers and not found.left and not self._loop:
            client.answer(None)
            return
        if place + 1 in self.plan.secrets:
            client.hide_next()
        self._play(client, found.take(loop=self._loop), client.go_on)
        if triggers and self._on_over is not None and not self.remaining:
            tell, self._on_over = self._on_over, None
            tell()

    def _play(
        self, client: LineClient, pieces: list[TimedLine], done: Callable[[], None] | None = None
    ) -> None:
        """Say pieces, each at its time; then it is done."""
        if not pieces:
            if done is not None:
                done()
            return
        for index, piece in enumerate(pieces):
            last = index == len(pieces) - 1

            def say(data: bytes = piece.data, last: bool = last) -> None:
                client.say_bytes(data)
                if last and done is not None:
                    done()

            self.after(piece.seconds / self._speed, say)

    def lost(self, link: ClientLink) -> None:
        """A link is gone; harmless when said twice."""
        client = self._clients.get(link)
        if client is not None:
            self._places.pop(client, None)
        super().lost(link)
