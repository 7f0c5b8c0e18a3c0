"""Run one client's task in one scene, and record its outcome and the messages on the wire."""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple, cast

from smartcam._arguments import check_kind, check_seconds
from smartcam.conformance.client._scenes import APPLICATIONS, Scene, read_container
from smartcam.conformance.client._tasks import Client, Outcome, Task
from smartcam.emulator import EmulatedCamera
from smartcam.protocols import Frame
from smartcam.protocols.messages import ResultContainer, Sender, StatusReport

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from smartcam.emulator._inside import LogEntry
    from smartcam.models import Status
    from smartcam.protocols import FramedDialect
    from smartcam.protocols.messages import Message

CLIENT_END_TIMEOUT = 0.3
"""Seconds that the camera waits for the last messages of a client that has ended."""

MAX_LINES = 40
"""Largest number of messages in a finding, one a line: the last ones are shown."""


class RecordedMessage(NamedTuple):
    """A message, or other bytes, on the wire."""

    time: float  # seconds since the scene began
    sender: Sender  # side that sent it
    peer: str  # address and port of the client
    message: Message | None  # decoded message; None for bytes that are no message of the dialect
    text: str  # the message with its fields, ``?`` for bytes that are no message
    hex: str  # the frame, or the other bytes
    error: str | None = None  # reason why the camera ignored the message, None if it did not
    lost: bool = False  # True if a fault kept the message from the client

    def __str__(self) -> str:
        """Return the message as a line: seconds, direction, message, bytes."""
        mark = ">" if self.sender is Sender.CLIENT else "<"
        note = f"  (ignored: {self.error})" if self.error else "  (lost)" if self.lost else ""
        data = self.hex if len(self.hex) <= 120 else self.hex[:120] + "..."
        return f"{self.time:7.3f} {mark} {self.text}  {data}{note}"


@dataclass(frozen=True, slots=True, kw_only=True)
class ClientRun:
    """A client's attempt at a task.

    Attributes:
        scene: the camera, its faults and the task.
        task: the task as the client got it.
        dialect: dialect of the camera.
        outcome: outcome as the client reports it.
        messages: messages on the wire, in the order in which the camera saw them.
        timeout: seconds that the client had.
    """

    scene: Scene
    task: Task
    dialect: FramedDialect
    outcome: Outcome
    messages: tuple[RecordedMessage, ...]
    timeout: float

    @property
    def requests(self) -> Iterator[tuple[int, RecordedMessage]]:
        """The client's messages, each with its index in ``messages``."""
        return (
            (n, message)
            for n, message in enumerate(self.messages)
            if message.sender is Sender.CLIENT
        )

    @property
    def sent_run_numbers(self) -> list[int]:
        """Run numbers of the results that the scene's application sent, in order."""
        numbers: list[int] = []
        for message in self.messages:
            if isinstance(message.message, ResultContainer) and not message.lost:
                content = read_container(message.message.data)
                if content is not None and content[0] == self.scene.application:
                    numbers.append(content[1])
        return numbers

    def status_before(self, index: int) -> Status | None:
        """Return the last status that the camera sent before message ``index``, if there is one."""
        for message in reversed(self.messages[:index]):
            if isinstance(message.message, StatusReport) and not message.lost:
                return message.message.status
        return None

    @property
    def lines(self) -> list[str]:
        """The last messages on the wire as lines, for people."""
        left_out = len(self.messages) - MAX_LINES
        lines = [str(message) for message in self.messages[-MAX_LINES:]]
        return [f"... {left_out} messages before" if left_out > 0 else "", *lines][left_out <= 0 :]


async def run_scene(
    client: Client,
    scene: Scene,
    *,
    dialect: str = "handbook",
    transport: str = "tcp",
    timeout: float = 30.0,
) -> ClientRun:
    """Run a client's task in a scene.

    Args:
        client: the client.
        scene: the camera and the task.
        dialect: name of the dialect that the camera speaks.
        transport: ``tcp`` or ``udp``.
        timeout: seconds that the client has.

    Raises:
        ConfigurationError: the client cannot be started.

    Cancellation: camera and client are ended.
    """
    check_kind(client, Client, "client", "a client", "run_scene")
    check_kind(scene, Scene, "scene", "a Scene", "run_scene")
    timeout = check_seconds(timeout, "timeout", "run_scene", exclusive=True)
    async with EmulatedCamera(
        APPLICATIONS,
        builtins=False,
        name=scene.name,
        dialect=dialect,
        transport=cast('Literal["tcp", "udp"]', transport),
        active=scene.active,
        running=scene.running,
        quirks=dict(scene.quirks),
    ) as camera:
        camera.inject(*scene.faults(camera.wire_dialect))
        task = Task(
            verb=scene.verb,
            number=scene.number,
            url=camera.url,
            host=camera.host,
            port=camera.port,
            transport=transport,
            dialect=dialect,
        )
        started_at = camera.clock.now
        outcome = await client.perform(task, timeout)
        await _wait_for_last_message(camera)
        messages = tuple(
            _record_entry(camera.wire_dialect, entry, started_at)
            for entry in _join_ignored_frames(camera.log)
        )
    return ClientRun(
        scene=scene,
        task=task,
        dialect=camera.wire_dialect,
        outcome=outcome,
        messages=messages,
        timeout=timeout,
    )


async def _wait_for_last_message(camera: EmulatedCamera) -> None:
    """Wait until the client has no connection, or, on UDP, sends no more messages."""
    deadline = time.monotonic() + CLIENT_END_TIMEOUT
    log_length = -1
    while time.monotonic() < deadline:
        # each turn of the loop handles data that the sockets have received already
        for _ in range(5):
            await asyncio.sleep(0)
        if not camera.links or (camera.transport == "udp" and len(camera.log) == log_length):
            return
        log_length = len(camera.log)
        await asyncio.sleep(0.01)


def _join_ignored_frames(log: Iterable[LogEntry]) -> list[LogEntry]:
    """Join each entry of an ignored frame with the next entry, which has the reason."""
    merged: list[LogEntry] = []
    for entry in log:
        previous = merged[-1] if merged else None
        if (
            entry.error is not None
            and previous is not None
            and previous.direction == entry.direction
            and previous.peer == entry.peer
            and previous.message_id is not None
            and previous.error is None
            and previous.hex == entry.hex
        ):
            merged[-1] = previous._replace(error=entry.error)
        else:
            merged.append(entry)
    return merged


def _record_entry(dialect: FramedDialect, entry: LogEntry, started_at: float) -> RecordedMessage:
    sent_hex = entry.wire
    if sent_hex is None and entry.message_id is not None:
        payload = bytes.fromhex(entry.hex)
        sent_hex = dialect.encode_frame(Frame(entry.message_id, payload)).hex(" ")
    return RecordedMessage(
        entry.time - started_at,
        Sender.CLIENT if entry.direction == "in" else Sender.CAMERA,
        entry.peer,
        entry.message,
        _message_text(dialect, entry.message),
        entry.hex if sent_hex is None else sent_hex,
        entry.error,
        entry.wire == "" or (entry.fault or "").endswith(("not sent", "connection ended")),
    )


def _message_text(dialect: FramedDialect, message: Message | None) -> str:
    if message is None:
        return "?"
    fields: list[str] = []
    for name in dialect.fields(type(message)):
        value: object = getattr(message, name)
        fields.append(f"{name}={value.hex() if isinstance(value, bytes) else value}")
    return f"{type(message).__name__}({', '.join(fields)})"
