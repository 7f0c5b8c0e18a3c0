"""Read values that a camera sends without a request: chunk data of pictures, and data of events.

A description has a port (GenICam's memory space) for each chunk and each event. A feature whose
register is in such a port has its value in the message, so reading it needs no request.

Source: GigE Vision 2.0, chapter 24.6 (chunks: data, id, length, from the end of the payload on);
GenApi 2.0, chapter 2.8.16 (``ChunkID`` and ``EventID`` of a Port).
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final

from smartcam.exceptions import MessageError
from smartcam.frames._codecs.threads import run_without_waiting
from smartcam.frames._gige.block import picture_bytes
from smartcam.frames._gige.features import GenicamFeatures

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.frames._features import FeatureValue
    from smartcam.frames._gige.block import WholePicture
    from smartcam.frames._gige.description import Element
    from smartcam.frames._gige.features import DeviceMemory

MAX_CHUNKS: Final = 256
"""Largest number of chunks of a picture."""

MAX_MESSAGE_FEATURES: Final = 256
"""Largest number of features that are read from one message."""

MAX_REFERENCES: Final = 32
"""Largest number of nodes that are searched for the port of a feature's message."""

_CHUNK_TAIL: Final = struct.Struct(">II")
_LEADS_TO_VALUE: Final = ("pValue", "pPort", "pVariable")


def cut_chunks(payload: memoryview) -> dict[int, memoryview]:
    """Return the chunks of a payload by their ids; the picture itself is one of them.

    Raises:
        MessageError: the lengths do not fit, or there are more chunks than any camera sends.
    """
    chunks: dict[int, memoryview] = {}
    end = len(payload)
    while end:
        if end < _CHUNK_TAIL.size or len(chunks) >= MAX_CHUNKS:
            raise MessageError(
                f"chunk data: expected at most {MAX_CHUNKS} chunks that fill {len(payload)} bytes, "
                f"{end} are left"
            )
        number, length = _CHUNK_TAIL.unpack_from(payload, end - _CHUNK_TAIL.size)
        begin = end - _CHUNK_TAIL.size - length
        if begin < 0 or number in chunks:
            raise MessageError(
                f"chunk data: chunk {number:#x} of {length} bytes "
                f"{'comes twice' if number in chunks else f'does not fit before byte {end}'}"
            )
        chunks[number] = payload[begin : end - _CHUNK_TAIL.size]
        end = begin
    return chunks


def doubt_about_size(picture: WholePicture, chunks: Mapping[str, FeatureValue]) -> str:
    """Return why a picture may not have the size of the features; "": no reason for doubt.

    Args:
        picture: picture whose size was taken from the camera's features.
        chunks: values that came with the picture.
    """
    leader = picture.leader
    need, size = picture_bytes(leader, picture.rows), f"{leader.width}x{leader.height}"
    try:
        *_, first = cut_chunks(picture.payload or memoryview(b"")).values()
    except (MessageError, ValueError) as exc:
        return f"a picture of {size} in chunk data that cannot be read: {exc}"
    if len(first) != need:
        return f"a picture of {size} has {need} bytes, the chunk that came has {len(first)}"
    for name, expected in (("ChunkWidth", leader.width), ("ChunkHeight", leader.height)):
        if chunks.get(name, expected) != expected:
            return f"its picture is {size} according to its features, but {name} is {chunks[name]}"
    return ""


class MessageFeatures(GenicamFeatures):
    """The features whose values come with messages of one kind.

    Args:
        features: features of the camera, whose description this shares.
        kind: ``ChunkID`` or ``EventID``.
    """

    def __init__(self, features: GenicamFeatures, kind: str) -> None:
        self.share_description(features)
        self._ports = _port_numbers(self._nodes, kind)
        self._message_parts: Mapping[int, memoryview] = {}
        self._by_number: dict[int, list[str]] = {}
        """Names of the features by the number of their port."""
        for name in features.names():
            number = self._message_number(name)
            if number is not None:
                self._by_number.setdefault(number, []).append(name)

    def find_number(self, beginning: str) -> int | None:
        """Return the number of the message with a feature whose name begins so; None: none."""
        for number, names in self._by_number.items():
            if any(name.startswith(beginning) for name in names):
                return number
        return None

    def read(self, parts: Mapping[int, memoryview]) -> tuple[dict[str, FeatureValue], list[str]]:
        """Return the values in a message by their features, and the problems in reading them.

        Args:
            parts: bytes of the chunks or of the event, by their numbers.
        """
        values: dict[str, FeatureValue] = {}
        problems: list[str] = []
        self._message_parts = parts
        try:
            names = [name for number in parts for name in self._by_number.get(number, ())]
            for name in names[:MAX_MESSAGE_FEATURES]:
                try:
                    values[name] = run_without_waiting(self._as_user_value(self._find_node(name)))
                except (MessageError, RuntimeError) as exc:
                    problems.append(f"{name}: {exc}")
        finally:
            self._message_parts = {}
        return values, problems

    def _memory(self, node: Element) -> DeviceMemory:
        number = self._ports.get(node.text_of("pPort"))
        if number is None:
            raise MessageError(f"{node.kind} {node.name} is a register of the camera")
        if number not in self._message_parts:
            raise MessageError(f"{node.kind} {node.name}: its message {number:#x} did not come")
        return _MessageBytes(self._message_parts[number])

    def _message_number(self, name: str) -> int | None:
        """Return the number of the message that has a feature's value; None: no message has it."""
        pending, seen = [name], set[str]()
        while pending and len(seen) < MAX_REFERENCES:
            reference = pending.pop()
            node = self._nodes.get(reference)
            if node is None or reference in seen:
                continue
            seen.add(reference)
            if reference in self._ports:
                return self._ports[reference]
            pending += [child.text for child in node.all(*_LEADS_TO_VALUE)]
        return None


class _MessageBytes:
    """The bytes of a message, which are read like registers."""

    def __init__(self, data: memoryview) -> None:
        self._data = data

    async def read(self, address: int, length: int) -> bytes:
        if address + length > len(self._data):
            raise MessageError(
                f"expected {length} bytes at {address:#x}, its message has {len(self._data)}"
            )
        return bytes(self._data[address : address + length])

    async def write(self, address: int, data: bytes) -> None:
        raise MessageError(f"{len(data)} bytes at {address:#x} of a message cannot be written")


def _port_numbers(nodes: Mapping[str, Element], kind: str) -> dict[str, int]:
    """Return the number of each port of the kind."""
    numbers: dict[str, int] = {}
    for node in nodes.values():
        text = node.text_of(kind) if node.kind == "Port" else ""
        if text:
            try:
                numbers[node.name] = int(text, 16)
            except ValueError as exc:
                raise MessageError(f"Port {node.name}: {kind} {text[:40]!r} is no number") from exc
    return numbers
