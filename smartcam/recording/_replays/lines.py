"""Emulate a recorded camera whose protocol consists of lines: send the recorded answers.

The n-th trigger gets the answer of the n-th recorded trigger, byte for byte and after the same
time; a trigger after the last recorded one gets no answer. Every other line gets the answer from
the same moment of the recording: before the first trigger, during the n-th one, or after its
answer. So a client that sends a line more or less often than the recorded client gets the state
that belongs to the trigger. A line that was not recorded ends the connection, since its
answer is unknown.
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
        answers: the answers.
        moments: moment of each answer: 0 before the first trigger, 2n - 1 during the n-th trigger,
            2n after its answer.
        next_index: index of the next answer, if they are played in order.
        asked_count: number of times that the line was sent during ``asked_moment``.
        asked_moment: moment that ``asked_count`` belongs to.
    """

    answers: list[list[TimedLine]] = field(default_factory=list[list[TimedLine]])
    moments: list[int] = field(default_factory=list[int])
    next_index: int = 0
    asked_count: int = 0
    asked_moment: int = -1

    @property
    def remaining(self) -> int:
        """Number of remaining answers of this round."""
        return max(0, len(self.answers) - self.next_index)

    def next_answer(self, *, loop: bool) -> list[TimedLine]:
        """Return the next answer; at the end repeat the last one, or with ``loop`` begin again."""
        if loop and self.next_index >= len(self.answers):
            self.next_index = 0
        answer = self.answers[min(self.next_index, len(self.answers) - 1)]
        self.next_index += 1
        return answer

    def next_answer_at(self, moment: int) -> list[TimedLine]:
        """Return the next answer of a moment; at the end repeat the last one.

        Without an answer at the moment, use the nearest moment of the same kind, and prefer earlier
        ones. Moments between triggers are one kind, moments during triggers the other.
        """
        if moment != self.asked_moment:
            self.asked_count, self.asked_moment = 0, moment
        nearest = min(
            self.moments, key=lambda at: ((at - moment) % 2, at > moment, abs(at - moment))
        )
        of_moment = [index for index, at in enumerate(self.moments) if at == nearest]
        answer = self.answers[of_moment[min(self.asked_count, len(of_moment) - 1)]]
        self.asked_count += 1
        return answer


@dataclass(slots=True)
class LinesPlan:
    """The answers of a recorded camera.

    Attributes:
        greeting: bytes sent before the first line.
        answers: answers to each line, by the line without its end.
        secrets: answers to lines that were not recorded, such as passwords, by the line's index in
            its session.
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
    """A line of the recorded client, and its answer."""

    at: float
    # the line; if it was not recorded, as a password is not: its index in the session
    line: bytes | int = 0
    item_index: int = 0  # index of the line's item in the recording
    answer_index: int | None = None  # index of the item with the end of the answer
    pieces: list[TimedLine] = field(default_factory=list[TimedLine])


def plan_lines(items: Iterable[Item], codec: LineCodec) -> LinesPlan:
    """Find the answer to each line: the bytes after the line, or the bytes with the line's key.

    Raises:
        RecordingError: the recording is more than :data:`MAX_REPLAY_BYTES`.
    """
    plan = LinesPlan()
    current, line_index, size = _AskedLine(0.0, pieces=plan.greeting), 0, 0
    by_key: dict[str, _AskedLine] = {}  # lines by the key that identifies their answers
    lines: list[_AskedLine] = []
    for item_index, item in enumerate(items):
        if isinstance(item, Disconnected):
            _drop_unanswered(lines)
            current, line_index = _AskedLine(item.at.timestamp()), 0
            by_key.clear()
        if not isinstance(item, TraceEntry) or item.direction == "!":
            continue
        at, data = item.at.timestamp(), bytes.fromhex(item.hex)
        size += len(data)
        if size > MAX_REPLAY_BYTES:
            raise RecordingError(
                f"recording: {size} bytes of lines, expected {MAX_REPLAY_BYTES} at most"
            )
        if item.direction == "<":
            answered = by_key.get(codec.answer_key(data), current)
            answered.at = answered.at or at  # a greeting answers no line
            answered.answer_index = item_index
            answered.pieces.append(TimedLine(max(0.0, at - answered.at), data))
            continue
        current = _AskedLine(at, line_text(codec, data) if data else line_index, item_index)
        by_key[codec.request_key(data)] = current
        lines.append(current)
        line_index += 1
    _drop_unanswered(lines)
    _add_answers(plan, lines, codec)
    return plan


def _drop_unanswered(lines: list[_AskedLine]) -> None:
    """Leave out the last line of a link that ended before its answer, which is unknown."""
    if lines and not lines[-1].pieces:
        lines.pop()


def _add_answers(plan: LinesPlan, lines: list[_AskedLine], codec: LineCodec) -> None:
    """Add the answers of lines to a plan."""
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
        answers.answers.append(asked.pieces)
        answers.moments.append(_moment(asked.item_index, triggers))


def _moment(item_index: int, triggers: list[_AskedLine]) -> int:
    """Return the moment of an item of a recording, see :class:`LineAnswers`."""
    triggers_before = bisect_left(triggers, item_index, key=lambda trigger: trigger.item_index)
    if not triggers_before:
        return 0
    answered_at = triggers[triggers_before - 1].answer_index
    return 2 * triggers_before - (answered_at is None or answered_at > item_index)


def is_trigger(codec: LineCodec, line: bytes) -> bool:
    """Return True if a client's line triggers the camera."""
    row = codec.row_of(line.decode(codec.encoding, "replace"))
    return codec.message_type(m.Sender.CLIENT, row) is m.Trigger


def line_text(codec: LineCodec, data: bytes) -> bytes:
    """Return a client's line without its end and without a ticket."""
    return codec.text(data).encode(codec.encoding, "replace")


class ReplayedLines(LineCamera):
    """An emulated camera that replays a camera whose protocol has lines; see :func:`replay`."""

    def __init__(
        self,
        camera_class: type[LineCamera],
        recording: Recording,
        *,
        camera: str | None = None,
        speed: float = 1.0,
        loop: bool = False,
        on_over: Callable[[], None] | None = None,
        **options: Any,
    ) -> None:
        recorded = recording.camera(camera)
        self._camera_class = camera_class
        self.also_hears: tuple[LineRow, ...] = (
            camera_class.also_hears if issubclass(camera_class, TicketedCamera) else ()
        )
        self._address = parse_address(recorded.url)
        self.protocol: Protocol = load_protocol(recorded.protocol)
        self.max_links: int = camera_class.max_links
        self.write_limit: int = camera_class.write_limit
        super().__init__(**{"name": recorded.name, **options})
        if recording.since is not None:
            raise ConfigurationError(
                f"recording {recording.path}: camera {recorded.name!r} has a protocol of text "
                "lines; such a recording is played from its beginning, not from a time on"
            )
        self.plan: LinesPlan = plan_lines(recording.items(recorded.name), self.lines)
        if not self.plan.answers:
            raise ConfigurationError(
                f"recording {recording.path}: it has no line to camera {recorded.name!r}"
            )
        self._speed, self._repeats = speed, loop
        dialect = next(iter(self.protocol.dialects.values()))
        self._accepts_lines_at_once = isinstance(dialect, LineDialect) and dialect.pipelined
        self._on_over = None if loop else on_over
        self._line_counts: dict[LineClient, int] = {}
        self._trigger_count = 0  # number of triggers so far
        self._last_answered = 0  # number of the last trigger whose whole answer was sent
        self._images = self._recorded_images(recording, recorded.name)

    def make_codec(self) -> LineCodec:
        """Return the codec of the recorded camera."""
        return self._camera_class.make_codec(self)

    def make_client(self, link: ClientLink, server: LineServer) -> LineClient:
        """Return a new client, of the class that the recorded camera has."""
        if issubclass(self._camera_class, TicketedCamera):
            return TicketedClient(self, link, server)
        return super().make_client(link, server)

    def on_raw_line(self, client: LineClient, message: HeardLine) -> None:
        """Store the key of a client's line: the recorded answer with this key is sent to it."""
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
                triggers += is_trigger(self.lines, line_text(self.lines, bytes.fromhex(item.hex)))
        images: dict[int, bytes] = {}
        size = 0
        for result, picture, _ in recording.results_with_pictures(camera):
            if picture is None:
                continue
            answer = self._camera_class.image_answer(eight_bits(picture))
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
        return self._images.get(min(self._trigger_count, max(self._images, default=0)))

    @property
    def remaining(self) -> int:
        """Number of remaining triggers of this round."""
        return sum(
            answers.remaining
            for line, answers in self.plan.answers.items()
            if is_trigger(self.lines, line)
        )

    def begins_session(self, message: HeardLine) -> bool:
        """Return True: any line begins the session, as one that was not recorded ends the link."""
        return True

    def greet(self, client: LineClient) -> None:
        """Send a client the bytes that the recorded camera sent before any line."""
        self._line_counts[client] = 0
        if 0 in self.plan.secrets:
            client.hide_next_line()
        self._send_pieces(client, self.plan.greeting)

    def hear(self, client: LineClient, line: str) -> None:
        """Answer a line with its recorded answer."""
        index = self._line_counts[client]
        self._line_counts[client] += 1
        if self._accepts_lines_at_once:
            client = client.answer_later()
        data = line.encode(self.lines.encoding, "replace")
        answers = self.plan.secrets.get(index) or self.plan.answers.get(data)
        if answers is None and (image := self._image_for(line)) is not None:
            self._send_pieces(client, [TimedLine(0.0, image)], client.end_line)
            return
        if answers is None:
            client.end(f"nothing in the recording answers {line[:64]!r}")
            return
        is_trigger_line = is_trigger(self.lines, data)
        self._trigger_count += is_trigger_line
        if is_trigger_line and not answers.remaining and not self._repeats:
            client.answer(None)
            return
        if index + 1 in self.plan.secrets:
            client.hide_next_line()
        pieces = self._answer_for(data, answers)
        on_sent = self._on_answer_sent(client, is_trigger=is_trigger_line and bool(pieces))
        self._send_pieces(client, pieces, on_sent)
        if is_trigger_line and self._on_over is not None and not self.remaining:
            on_over, self._on_over = self._on_over, None
            on_over()

    def _answer_for(self, line: bytes, answers: LineAnswers) -> list[TimedLine]:
        """Return the recorded answer in ``answers`` that a line gets now."""
        if (
            is_trigger(self.lines, line)
            or not self.plan.triggers
            or answers is not self.plan.answers.get(line)
        ):
            return answers.next_answer(loop=self._repeats)
        return answers.next_answer_at(self._moment())

    def _moment(self) -> int:
        """Return the moment of the recording that is played, see :class:`LineAnswers`."""
        number = self._trigger_count
        if self._repeats and number:
            number = (number - 1) % self.plan.triggers + 1
        return 2 * number - (self._last_answered < self._trigger_count)

    def _on_answer_sent(self, client: LineClient, *, is_trigger: bool) -> Callable[[], None]:
        """Return the function to call when the whole answer to a line is sent."""
        number = self._trigger_count

        def on_sent() -> None:
            if is_trigger:
                self._last_answered = max(self._last_answered, number)
            client.end_line()

        return on_sent

    def _send_pieces(
        self, client: LineClient, pieces: list[TimedLine], on_sent: Callable[[], None] | None = None
    ) -> None:
        """Send pieces, each at its time; then call ``on_sent``."""
        if not pieces:
            if on_sent is not None:
                on_sent()
            return
        for index, piece in enumerate(pieces):
            last = index == len(pieces) - 1

            def say(data: bytes = piece.data, last: bool = last) -> None:
                client.say_recorded(data)
                if last and on_sent is not None:
                    on_sent()

            self.after(piece.seconds / self._speed, say)

    def forget_link(self, link: ClientLink) -> None:
        """Remove a closed link; a second call does nothing."""
        client = self._clients.get(link)
        if client is not None:
            self._line_counts.pop(client, None)
        super().forget_link(link)
