"""Publish results and states over MQTT 5, and carry out commands from it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import ssl
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, cast
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field

from smartcam._extras import load
from smartcam._json import object_json
from smartcam.exceptions import (
    ConfigurationError,
    EntryRefusedError,
    OutletError,
    SmartCamError,
)
from smartcam.outlets._outlet import Outlet
from smartcam.outlets._settings import OutletSettings, Secret

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from smartcam.outlets._entry import OutletEntry
    from smartcam.outlets._outlet import OutletContext

logger: logging.Logger = logging.getLogger("smartcam.outlets")

MAX_HEADER_BYTES = 12
"""Number of bytes of an MQTT packet besides its topic and its text, which are the packet's type,
three lengths, its number and its properties."""

MAX_COMMANDS = 1_000
"""Largest number of commands that run at the same time, such as a trigger of each camera. Further
commands are answered with an error. As many received messages may wait to be read."""

MAX_WAITING_BYTES = 1 << 26
"""Largest number of bytes of received messages that wait; further messages are not answered."""

MAX_COMMAND_BYTES = 1 << 16
"""Largest number of bytes of a command's message."""

MAX_STATES = 10_000
"""Largest number of cameras whose state is kept."""

_PORTS = {"mqtt": 1883, "mqtts": 8883}
_VERBS = ("trigger", "switch")
_ENTRY_TOPICS = ("result/", "error/", "gap/")
"""Topics of entries begin with one of these, after the first part of every topic."""

_REPLACED_CHARACTERS = dict.fromkeys(map(ord, "+#\0"), "_")


def _check_broker(text: str) -> str:
    try:
        parts = urlsplit(text)
        fits = parts.scheme in _PORTS and parts.hostname and not (parts.path or parts.query)
        _ = parts.port
    except ValueError:
        fits, parts = False, None
    if not fits or parts is None:
        raise ValueError("expected mqtt://HOST[:PORT] or mqtts://HOST[:PORT]")
    if parts.username is not None or parts.password is not None:
        raise ValueError('expected no user in the address: set "user" and "password" instead')
    return text


def _check_topic(text: str) -> str:
    if set("+#\0") & set(text) or text.startswith(("/", "$")) or text.endswith("/"):
        raise ValueError("expected a topic without + and #, such as plant1/smartcam")
    return text


class MqttSettings(OutletSettings):
    """The settings of an outlet over MQTT."""

    broker: Annotated[str, AfterValidator(_check_broker)] = Field(
        description="mqtt://HOST[:1883], or mqtts://HOST[:8883] for TLS"
    )
    user: str | None = Field(None, description="name to log in with")
    password: Secret | None = Field(
        None, description="source of the password: {file: PATH} or {variable: NAME}"
    )
    ca: str | None = Field(
        None, min_length=1, description="file of the broker's authority, relative to this file"
    )
    topic: Annotated[str, AfterValidator(_check_topic)] = Field(
        "smartcam", min_length=1, max_length=200, description="first part of every topic"
    )
    client_id: str | None = Field(
        None, min_length=1, max_length=100, description="client id; default: smartcam-NAME"
    )
    commands: bool = Field(
        False,
        description="whether clients that may publish to TOPIC/command/# may trigger cameras and "
        "switch applications; limit these clients in the broker",
    )
    largest: int = Field(
        10_000_000,
        ge=1000,
        le=268_000_000,
        description="largest number of bytes of a message with its topic",
    )


class _CommandQueue(asyncio.Queue[Any]):
    """A queue of messages that bounds their number and their total bytes."""

    _bytes = 0

    def full(self) -> bool:
        """Return True if no further message may be added."""
        return super().full() or self._bytes >= MAX_WAITING_BYTES

    def _put(self, item: Any) -> None:
        self._bytes += len(item.payload or b"")
        super()._put(item)

    def _get(self) -> Any:
        item: Any = super()._get()
        self._bytes -= len(item.payload or b"")
        return item


class _TlsSocket(ssl.SSLSocket):
    """A socket that closes itself if its handshake fails, since paho would leave it open."""

    def do_handshake(self, block: bool = False) -> None:
        """Do the handshake."""
        try:
            super().do_handshake(block)
        except BaseException:
            self.close()
            raise


class MqttOutlet(Outlet[MqttSettings]):
    """Publishes entries with QoS 1 and retained states, and carries out commands."""

    settings_class = MqttSettings
    max_batch: ClassVar[int] = 100

    def __init__(
        self, name: str, settings: MqttSettings, folder: Path, context: OutletContext
    ) -> None:
        super().__init__(name, settings, folder, context)
        self._stack = contextlib.AsyncExitStack()
        self._client: Any = None
        self._connection_task: asyncio.Task[None] | None = None
        self._refusal_reason = ""
        self._max_message_bytes = settings.largest
        self._states: dict[str, Mapping[str, Any]] = {}
        self._unsent_states: set[str] = set()
        self._changed = asyncio.Event()
        self._commands: set[asyncio.Task[None]] = set()

    async def open(self) -> None:
        """Connect to the broker.

        Raises:
            ConfigurationError: a secret or the authority's file does not exist.
            MissingExtraError: aiomqtt is not installed.
            Exception: the broker cannot be reached, or refuses the connection.
        """
        aiomqtt = load("aiomqtt")
        settings, online_topic = self.settings, f"{self.settings.topic}/outlet/{self.name}"
        parts = urlsplit(settings.broker)
        password = None if settings.password is None else settings.password.read(self.folder)
        self._client = client = aiomqtt.Client(
            parts.hostname,
            parts.port or _PORTS[parts.scheme],
            username=settings.user,
            password=password,
            identifier=settings.client_id or f"smartcam-{self.name}",
            protocol=aiomqtt.ProtocolVersion.V5,
            will=aiomqtt.Will(online_topic, '{"online":false}', qos=1, retain=True),
            timeout=settings.timeout,
            keepalive=10,
            clean_start=True,  # earlier commands would be carried out too late
            queue_type=_CommandQueue,
            max_queued_incoming_messages=MAX_COMMANDS,
            tls_context=self._tls() if parts.scheme == "mqtts" else None,
        )
        client.pending_calls_threshold = 2 * self.max_batch + 2 * MAX_COMMANDS
        self._watch_refusals(client)
        self._refusal_reason, self._max_message_bytes = "", settings.largest
        stack = contextlib.AsyncExitStack()
        self._stack = stack
        await stack.enter_async_context(client)
        if settings.commands and self.context.command is not None:
            for verb in _VERBS:
                await client.subscribe(f"{settings.topic}/command/{verb}/#", qos=1)
        await client.publish(online_topic, '{"online":true}', qos=1, retain=True)
        self._unsent_states.update(self._states)
        self._changed.set()
        self._connection_task = asyncio.get_running_loop().create_task(
            self._serve_connection(client)
        )

    def _tls(self) -> ssl.SSLContext:
        ca = self.settings.ca
        try:
            context = ssl.create_default_context(cafile=None if ca is None else self.folder / ca)
        except OSError as exc:
            raise ConfigurationError(f"outlet {self.name}: ca: {ca}: {exc}") from exc
        context.sslsocket_class = _TlsSocket
        return context

    def _watch_refusals(self, client: Any) -> None:
        """Note the messages that the broker refuses, since aiomqtt does not report them."""
        paho = client._client  # noqa: SLF001
        publish_inner, on_publish_inner = paho.publish, paho.on_publish
        on_connect_inner = paho.on_connect
        topics: dict[int, str] = {}  # topics of messages that are not acknowledged yet

        def publish(topic: str, *arguments: Any, **options: Any) -> Any:
            info = publish_inner(topic, *arguments, **options)
            topics[info.mid] = topic
            return info

        def on_publish(sender: Any, data: Any, number: int, reason: Any, properties: Any) -> None:
            topic = topics.pop(number, "")
            if reason is not None and reason.is_failure:
                if topic.removeprefix(f"{self.settings.topic}/").startswith(_ENTRY_TOPICS):
                    self._refusal_reason = str(reason)
                else:  # a state, or an answer to a command
                    logger.warning(
                        "outlet %s: the broker refused a message to %.120s: %s",
                        *(self.name, topic, reason),
                    )
            on_publish_inner(sender, data, number, reason, properties)

        def on_connect(
            sender: Any, data: Any, flags: Any, reason: Any, properties: Any = None
        ) -> None:
            packet_bytes = getattr(properties, "MaximumPacketSize", None)
            if packet_bytes is not None:
                limit = packet_bytes - MAX_HEADER_BYTES
                self._max_message_bytes = min(self._max_message_bytes, limit)
            on_connect_inner(sender, data, flags, reason, properties)

        paho.publish, paho.on_publish, paho.on_connect = publish, on_publish, on_connect

    def _topic(self, kind: str, camera: str) -> str:
        """Return the topic of a camera, with _ for characters that topics may not have."""
        return f"{self.settings.topic}/{kind}/{camera.translate(_REPLACED_CHARACTERS)}"

    async def deliver(self, entries: Sequence[OutletEntry]) -> None:
        """Publish entries to TOPIC/KIND/CAMERA; return when the broker has acknowledged all."""
        messages = [_entry_message(entry) for entry in entries]
        topics = [self._topic(entry.kind, entry.camera or "all") for entry in entries]
        sizes = [
            len(topic.encode()) + len(message)
            for topic, message in zip(topics, messages, strict=True)
        ]
        count, limit = len(messages), self._max_message_bytes
        too_large = next((index for index, size in enumerate(sizes) if size > limit), None)
        if too_large is not None:
            count = too_large
        await self._publish_while_connected(
            [
                self._client.publish(topic, message, qos=1)
                for topic, message in zip(topics[:count], messages[:count], strict=True)
            ]
        )
        if too_large is not None:
            text = f"{sizes[too_large]} bytes, {limit} are allowed"
            raise EntryRefusedError(text, index=too_large)

    async def _publish_while_connected(self, calls: list[Any]) -> None:
        """Await calls that publish; raise if the connection to the broker is lost before.

        The messages are sent in order. No message waits for the acknowledgement of the one before.
        """
        connection_task = self._connection_task
        if connection_task is None:
            for call in calls:
                call.close()
            raise OutletError("not connected to the broker")
        publishing: asyncio.Future[Any] = asyncio.gather(*calls)
        try:
            ends: set[asyncio.Future[Any]] = {publishing, connection_task}
            await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
            if connection_task.done():
                connection_task.result()
            await publishing
        finally:
            publishing.cancel()
            with contextlib.suppress(asyncio.CancelledError, Exception):
                await publishing
        if self._refusal_reason:
            raise OutletError(f"the broker refused a message: {self._refusal_reason}")

    def state_changed(self, camera: str, state: Mapping[str, Any]) -> None:
        """Have the camera's state published soon, as a retained message."""
        if camera in self._states or len(self._states) < MAX_STATES:
            self._states[camera] = state
            self._unsent_states.add(camera)
            self._changed.set()

    async def watch(self) -> None:
        """Wait until the connection to the broker is lost."""
        if self._connection_task is not None:
            await asyncio.shield(self._connection_task)

    async def close(self) -> None:
        """Disconnect from the broker."""
        tasks = [
            *self._commands,
            *([self._connection_task] if self._connection_task is not None else []),
        ]
        self._connection_task = None
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)
        client = self._client
        if client is not None and tasks:
            topic = f"{self.settings.topic}/outlet/{self.name}"
            with contextlib.suppress(Exception):
                await client.publish(topic, '{"online":false}', qos=1, retain=True, timeout=1)
        self._client = None
        await self._stack.aclose()

    # ------------------------------------------------------------------ states and commands

    async def _serve_connection(self, client: Any) -> None:
        """Publish states and receive commands until the connection to the broker is lost."""
        loop = asyncio.get_running_loop()
        state_task = loop.create_task(self._send_states(client))
        command_task = loop.create_task(self._receive_commands(client))
        try:
            await asyncio.wait({state_task, command_task}, return_when=asyncio.FIRST_COMPLETED)
            for task in (state_task, command_task):
                if task.done():
                    task.result()
            raise OutletError("the broker is gone")
        finally:
            for task in (state_task, command_task):
                task.cancel()
            await asyncio.wait({state_task, command_task})

    async def _send_states(self, client: Any) -> None:
        while True:
            await self._changed.wait()
            self._changed.clear()
            while self._unsent_states:
                camera = self._unsent_states.pop()
                try:
                    text = object_json({"camera": camera, **self._states[camera]})
                    topic = self._topic("state", camera)
                    await client.publish(topic, text, qos=1, retain=True)
                except BaseException:
                    self._unsent_states.add(camera)
                    raise

    async def _receive_commands(self, client: Any) -> None:
        async for message in client.messages:
            if message.retain:
                continue  # a retained command would be carried out again in each session
            task = asyncio.get_running_loop().create_task(self._answer_command(client, message))
            self._commands.add(task)
            task.add_done_callback(self._commands.discard)

    async def _answer_command(self, client: Any, message: Any) -> None:
        verb, _, camera = (
            str(message.topic).removeprefix(f"{self.settings.topic}/command/").partition("/")
        )
        reply = await self._carry_out(verb, camera, message.payload)
        request_properties = message.properties
        topic = getattr(request_properties, "ResponseTopic", None)
        properties = None
        if not topic or "+" in topic or "#" in topic:
            topic = f"{self.settings.topic}/reply/{verb}/{camera}"
        correlation = getattr(request_properties, "CorrelationData", None)
        if correlation is not None:
            properties = load("paho.mqtt.properties").Properties(
                load("paho.mqtt.packettypes").PacketTypes.PUBLISH
            )
            properties.CorrelationData = correlation
        with contextlib.suppress(load("aiomqtt").MqttError):  # then the client gets no answer
            await client.publish(topic, object_json(reply), qos=1, properties=properties)

    async def _carry_out(self, verb: str, camera: str, payload: object) -> dict[str, Any]:
        fields: dict[str, Any] = {"camera": camera}
        try:
            arguments = _command_fields(payload)
            if "id" in arguments:
                fields["id"] = arguments.pop("id")
            if len(self._commands) > MAX_COMMANDS:
                raise OutletError(f"{MAX_COMMANDS} commands are under way already")
            if self.context.command is None or not self.settings.chooses(camera):
                raise ConfigurationError(f"there is no camera {camera!r:.120} here")
            outcome = await self.context.command(camera, verb, arguments)
        except SmartCamError as exc:
            return {**fields, "ok": False, "error": str(exc), "kind": type(exc).__name__}
        return {**fields, "ok": True, **outcome}


def _entry_message(entry: OutletEntry) -> bytes:
    """Return an entry's JSON, with its id as the first field."""
    head = (
        {"id": entry.id, "camera": entry.camera}
        if '"camera":' not in entry.body
        else {"id": entry.id}
    )
    return f"{object_json(head)[:-1]},{entry.body[1:]}".encode()


def _command_fields(payload: object) -> dict[str, Any]:
    """Return the fields of a command's message; an empty message has none.

    Raises:
        ConfigurationError: the message is too large, or no JSON object.
    """
    data = bytes(payload) if isinstance(payload, (bytes, bytearray)) else b"?"
    if len(data) > MAX_COMMAND_BYTES:
        raise ConfigurationError(f"{len(data)} bytes, expected {MAX_COMMAND_BYTES} at most")
    if not data.strip():
        return {}
    try:
        fields: object = json.loads(data)
    except (ValueError, RecursionError):
        fields = None
    if not isinstance(fields, dict):
        raise ConfigurationError("expected a JSON object, or nothing")
    return cast("dict[str, Any]", fields)
