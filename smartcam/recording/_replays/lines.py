"""Emulate a recorded camera whose protocol has lines: each line gets its recorded answer.

The n-th trigger gets the answer of the n-th recorded one, byte for byte and after the same time; a
trigger after the last one gets no answer. Every other line gets the camera's answer at the same
moment of the recording: before the first trigger, during the n-th one, or after its answer. So a
client that sends a line more or less often than the recorded one gets the state that belongs to
the trigger. A line that was not recorded ends the connection, since its answer is unknown.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.emulator import LineCamera, LineClient, TicketedCamera, TicketedClient
from smartcam.exceptions import ConfigurationError, RecordingError
from smartcam.models import Disconnected, Result
from smartcam.observers import TraceEntry
from smartcam.protocols import LineDialect
from smartcam.protocols import messages as m
from smartcam.protocols._inside import load_protocol
from smartcam.recording._replays.schedule import MAX_REPLAY_BYTES
from smartcam.settings import parse_address

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    import numpy as np
    from numpy.typing import NDArray

    from smartcam.emulator._inside import ClientLink, HeardLine, LineCodec, LineServer
    from smartcam.frames import Frame
    from smartcam.protocols import LineRow, Protocol
    from smartcam.recording._mcap.form import Item
    from smartcam.recording._reader import Recording


class TimedLine(NamedTuple):
    """Bytes that the camera sent, and the seconds since the line that they answer."""

    seconds: float
    data: bytes


@dataclass(slots=True)
class LineAnswers:
    """The answers to a line, for each time that the client sent it.

    Attributes:
        given: the answers.
        moments: the moment of each: 0 before the first trigger, 2n - 1 during the n-th one, 2n
            after its answer.
        next: index of the next answer, if they are played in order.
        asked: number of times that the line was sent since the moment began.
        asked_at: moment that `asked` counts in.
    """

    given: list[list[TimedLine]] = field(default_factory=list[list[TimedLine]])
    moments: list[int] = field(default_factory=list[int])
    next: int = 0
    asked: int = 0
    asked_at: int = -1

    @property
    def left(self) -> int:
        """Number of answers that are left, in this round."""
        return max(0, len(self.given) - self.next)

    def take(self, *, loop: bool) -> list[TimedLine]:
        """Return the next answer; after the last one the last again, or with ``loop`` the first."""
        if loop and self.next >= len(self.given):
            self.next = 0
        answer = self.given[min(self.next, len(self.given) - 1)]
        self.next += 1
        return answer

    def take_at(self, moment: int) -> list[TimedLine]:
        """Return the next answer of a moment; after its last one the last again.

        Without an answer at the moment, use the nearest moment of the same kind, earlier ones
        first: before and after triggers are one kind, during triggers is the other.
        """
        if moment != self.asked_at:
            self.asked, self.asked_at = 0, moment
        nearest = min(
            self.moments, key=lambda at: ((at - moment) % 2, at > moment, abs(at - moment))
        )
        of_moment = [place for place, at in enumerate(self.moments) if at == nearest]
        answer = self.given[of_moment[min(self.asked, len(of_moment) - 1)]]
        self.asked += 1
        return answer


@dataclass(slots=True)
class LinesPlan:
    """The answers of a recorded camera.

    Attributes:
        greeting: bytes sent before the first line.
        answers: answers to each line, by the line without its end.
        secrets: answers to lines that were not recorded, such as passwords, by place in a session.
        triggers: number of triggers that were recorded.
    """

    greeting: list[TimedLine] = field(default_factory=list[TimedLine])
    answers: dict[bytes, LineAnswers] = field(default_factory=dict[bytes, LineAnswers])
    secrets: dict[int, LineAnswers] = field(default_factory=dict[int, LineAnswers])
    triggers: int = 0


def eight_bits(picture: Frame) -> NDArray[np.uint8]:
    """Return the brightness of a picture; with more than 8 bits, the upper 8."""
    grey: NDArray[Any] = picture.grey()
    if grey.dtype.itemsize > 1:
        grey = grey >> (picture.format.depth - 8)
    return grey.astype("u1")


@dataclass(slots=True)
class _AskedLine:
    """A line of the recorded client: its answer, and its begin and end in the recording.

    A line that was not recorded, such as a password, is identified by its place in the session.
    """

    at: float
    line: bytes | int = 0
    begin: int = 0
    end: int | None = None
    pieces: list[TimedLine] = field(default_factory=list[TimedLine])


def plan_lines(items: Iterable[Item], codec: LineCodec) -> LinesPlan:
    """Find the answer to each line: bytes after it, or bytes that name it as their request.

    Raises:
        RecordingError: the recording is more than :data:`MAX_REPLAY_BYTES`.
    """
    plan = LinesPlan()
    now, place, size = _AskedLine(0.0, pieces=plan.greeting), 0, 0
    known: dict[str, _AskedLine] = {}  # lines by the key that identifies their answers
    lines: list[_AskedLine] = []
    for number, item in enumerate(items):
        if isinstance(item, Disconnected):
            _forget_silence(lines)
            now, place = _AskedLine(item.at.timestamp()), 0
            known.clear()
        if not isinstance(item, TraceEntry) or item.direction == "!":
            continue
        at, data = item.at.timestamp(), bytes.fromhex(item.hex)
        size += len(data)
        if size > MAX_REPLAY_BYTES:
            raise RecordingError(
                f"recording: {size} bytes of lines, expected {MAX_REPLAY_BYTES} at most"
            )
        if item.direction == "<":
            answered = known.get(codec.answer_key(data), now)
            answered.at = answered.at or at  # a greeting answers no line
            answered.end = number
            answered.pieces.append(TimedLine(max(0.0, at - answered.at), data))
            continue
        now = _AskedLine(at, bare(codec, data) if data else place, number)
        known[codec.request_key(data)] = now
        lines.append(now)
        place += 1
    _forget_silence(lines)
    _arrange(plan, lines, codec)
    return plan


def _forget_silence(lines: list[_AskedLine]) -> None:
    """Leave out the last line of a link that ended before its answer, which is unknown."""
    if lines and not lines[-1].pieces:
        lines.pop()


def _arrange(plan: LinesPlan, lines: list[_AskedLine], codec: LineCodec) -> None:
    """Add the answer of each line to a plan."""
    triggers = [
        asked for asked in lines if isinstance(asked.line, bytes) and is_trigger(codec, asked.line)
    ]
    plan.triggers = len(triggers)
    for asked in lines:
        answers = (
            plan.answers.setdefault(asked.line, LineAnswers())
            if isinstance(asked.line, bytes)
            else plan.secrets.setdefault(asked.line, LineAnswers())
        )
        answers.given.append(asked.pieces)
        answers.moments.append(_moment(asked.begin, triggers))


def _moment(place: int, triggers: list[_AskedLine]) -> int:
    """Return the moment of a place in a recording, see :class:`LineAnswers`."""
    before = bisect_left(triggers, place, key=lambda trigger: trigger.begin)
    end = triggers[before - 1].end if before else None
    return 2 * before - (before > 0 and (end is None or end > place))


def is_trigger(codec: LineCodec, line: bytes) -> bool:
    """Return True if a client's line triggers the camera."""
    row = codec.row_of(line.decode(codec.encoding, "replace"))
    return codec.message_type(m.Sender.CLIENT, row) is m.Trigger


def bare(codec: LineCodec, data: bytes) -> bytes:
    """Return a client's line without its end, and without parts that differ each time."""
    return codec.text(data).encode(codec.encoding, "replace")


class ReplayedLines(LineCamera):
    """An emulated camera that replays a camera whose protocol has lines; see :func:`replay`."""

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
        self.also_hears: tuple[LineRow, ...] = (
            kind.also_hears if issubclass(kind, TicketedCamera) else ()
        )
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
        self.plan: LinesPlan = plan_lines(recording.items(known.name), self.lines)
        if not self.plan.answers:
            raise ConfigurationError(
                f"recording {recording.path}: no line to camera {known.name!r} is in it"
            )
        self._speed, self._loop = speed, loop
        spoken = next(iter(self.protocol.dialects.values()))
        self._at_once = isinstance(spoken, LineDialect) and spoken.at_once
        self._on_over = None if loop else on_over
        self._places: dict[LineClient, int] = {}
        self._triggered = 0  # triggers that were played
        self._answered = 0  # the last trigger whose whole answer was sent
        self._images = self._recorded_images(recording, known.name)

    def make_codec(self) -> LineCodec:
        """Return the codec of the recorded camera."""
        return self._kind.make_codec(self)

    def make_client(self, link: ClientLink, server: LineServer) -> LineClient:
        """Return a new client of the recorded camera's kind."""
        if issubclass(self._kind, TicketedCamera):
            return TicketedClient(self, link, server)
        return super().make_client(link, server)

    def begun(self, client: LineClient, message: HeardLine) -> None:
        """Note the unchanged line of a client."""
        if isinstance(client, TicketedClient):
            client.ticket = self.lines.request_key(message.data)

    @property
    def url(self) -> str:
        """The camera's URL, with the recorded one's parameters."""
        return self._address._replace(host=self.host, port=self.port).url

    def _recorded_images(self, recording: Recording, camera: str) -> dict[int, bytes]:
        """Return the answers to a request for a picture, by the number of triggers before it."""
        if not recording.counts.pictures:
            return {}
        triggers, of_result = 0, dict[int, int]()
        for item in recording.items(camera):
            if isinstance(item, Result):
                of_result[item.number] = triggers
            elif isinstance(item, TraceEntry) and item.direction == ">":
                triggers += is_trigger(self.lines, bare(self.lines, bytes.fromhex(item.hex)))
        images: dict[int, bytes] = {}
        size = 0
        for result, picture, _ in recording.judged(camera):
            if picture is None:
                continue
            answer = self._kind.image_answer(eight_bits(picture))
            if answer is None:
                return {}
            images[of_result[result.number]] = answer
            size += len(answer)
            if size > MAX_REPLAY_BYTES:
                raise RecordingError(
                    f"recording: {size} bytes of pictures, expected {MAX_REPLAY_BYTES} at most"
                )
        return images

    def _image_for(self, line: str) -> bytes | None:
        """Return the picture of the last trigger; None for another line, or without a picture."""
        row = self.lines.row_of(line)
        if self.lines.message_type(m.Sender.CLIENT, row) is not m.ReadImage:
            return None
        return self._images.get(min(self._triggered, max(self._images, default=0)))

    @property
    def remaining(self) -> int:
        """Number of triggers that are left, in this round."""
        return sum(
            answers.left
            for line, answers in self.plan.answers.items()
            if is_trigger(self.lines, line)
        )

    def begins_session(self, message: HeardLine) -> bool:
        """Return True: an unrecorded line ends the connection."""
        return True

    def greet(self, client: LineClient) -> None:
        """Send a client the bytes that the recorded camera sent before any line."""
        self._places[client] = 0
        if 0 in self.plan.secrets:
            client.hide_next_line()
        self._play(client, self.plan.greeting)

    def hear(self, client: LineClient, line: str) -> None:
        """Answer a line with its recorded answer."""
        place = self._places[client]
        self._places[client] += 1
        if self._at_once:
            client = client.answer_later()
        data = line.encode(self.lines.encoding, "replace")
        answers = self.plan.secrets.get(place) or self.plan.answers.get(data)
        if answers is None and (image := self._image_for(line)) is not None:
            self._play(client, [TimedLine(0.0, image)], client.end_line)
            return
        if answers is None:
            client.end(f"nothing in the recording answers {line[:64]!r}")
            return
        triggers = is_trigger(self.lines, data)
        self._triggered += triggers
        if triggers and not answers.left and not self._loop:
            client.answer(None)
            return
        if place + 1 in self.plan.secrets:
            client.hide_next_line()
        pieces = self._take(data, answers)
        self._play(client, pieces, self._ended(client, trigger=triggers and bool(pieces)))
        if triggers and self._on_over is not None and not self.remaining:
            on_over, self._on_over = self._on_over, None
            on_over()

    def _take(self, line: bytes, answers: LineAnswers) -> list[TimedLine]:
        """Return the recorded pieces that answer a line now."""
        if (
            is_trigger(self.lines, line)
            or not self.plan.triggers
            or answers is not self.plan.answers.get(line)
        ):
            return answers.take(loop=self._loop)
        return answers.take_at(self._moment())

    def _moment(self) -> int:
        """Return the moment of the recording that is played, see :class:`LineAnswers`."""
        number = self._triggered
        if self._loop and number:
            number = (number - 1) % self.plan.triggers + 1
        return 2 * number - (self._answered < self._triggered)

    def _ended(self, client: LineClient, *, trigger: bool) -> Callable[[], None]:
        """Return the function to call when the whole answer to a line is sent."""
        number = self._triggered

        def end() -> None:
            if trigger:
                self._answered = max(self._answered, number)
            client.end_line()

        return end

    def _play(
        self, client: LineClient, pieces: list[TimedLine], done: Callable[[], None] | None = None
    ) -> None:
        """Send pieces, each at its time; then call ``end``."""
        if not pieces:
            if done is not None:
                done()
            return
        for index, piece in enumerate(pieces):
            last = index == len(pieces) - 1

            def say(data: bytes = piece.data, last: bool = last) -> None:
                client.say_recorded(data)
                if last and done is not None:
                    done()

            self.after(piece.seconds / self._speed, say)

    def lost(self, link: ClientLink) -> None:
        """Remove a closed link; a second call does nothing."""
        client = self._clients.get(link)
        if client is not None:
            self._places.pop(client, None)
        super().lost(link)
