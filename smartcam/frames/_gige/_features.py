"""A camera's features by their names, as its GenICam description tells how to reach them.

Source: GenApi 2.0, chapter 2.8 (kinds of nodes and what their elements mean); SFNC (names).
"""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING, Final, Literal, Protocol, TypeAlias

from smartcam._suggestions import did_you_mean
from smartcam.exceptions import FrameSourceError, MessageError
from smartcam.frames._gige._expressions import evaluate
from smartcam.frames._gige._gvcp import text

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.frames._gige._description import Element

Value: TypeAlias = "int | float | str | bool"

DEEPEST: Final = 64
"""Nodes that lead to each other: beyond that it is a circle."""

MOST_STEPS: Final = 5000
"""Nodes that are looked at for one value."""

LONGEST: Final = 4096
"""Bytes of a register."""

_REGISTERS: Final = ("IntReg", "MaskedIntReg", "StructEntry")
_KNIVES: Final = ("SwissKnife", "IntSwissKnife")
_CONVERTERS: Final = ("Converter", "IntConverter")
_HOLDERS: Final = ("Integer", "Float", "Boolean", "Enumeration", "String", "Command")
_WHOLE: Final = ("Integer", "IntSwissKnife", "IntConverter", "Enumeration", "Boolean", *_REGISTERS)
_TEXTS: Final = ("String", "StringReg")


class DeviceMemory(Protocol):
    """The camera's memory."""

    async def read(self, address: int, length: int) -> bytes:
        """Return ``length`` bytes."""
        ...

    async def write(self, address: int, data: bytes) -> None:
        """Write them."""
        ...


class GenicamFeatures:
    """What can be asked of a camera, and set.

    Nothing is kept between two calls but what the description itself holds.

    Args:
        nodes: of its description.
        port: its memory.
        source: its name, for errors.
    """

    def __init__(self, nodes: Mapping[str, Element], port: DeviceMemory, source: str) -> None:
        self._nodes, self._port, self._source = nodes, port, source
        self._held: dict[str, Value] = {}  # what nodes with a <Value> were set to
        self._read: dict[tuple[int, int], bytes] = {}
        self._steps = 0

    def __contains__(self, name: object) -> bool:
        """Return whether the description has it."""
        return name in self._nodes

    def names(self) -> list[str]:
        """Return the features, as the description's categories list them."""
        listed = [
            one.text
            for node in self._nodes.values()
            if node.kind == "Category"
            for one in node.all("pFeature")
        ]
        return sorted({name for name in listed if self._kind(name) not in ("", "Category")})

    async def get(self, name: str) -> Value:
        """Return a feature's value: of an enumeration the entry's name.

        Raises:
            FrameSourceError: there is none of that name, it is not available now, or has no value.
        """
        node = await self._begin(name)
        try:
            value = await self._get(node, 0)
            if node.kind == "Enumeration":
                return next(
                    (entry for entry, number in _entries(node).items() if number == value), value
                )
            if node.kind == "Boolean":
                return value == _on(node)
        except MessageError as exc:
            raise self._wrong(name, str(exc)) from exc
        return value

    async def number(self, name: str) -> float | None:
        """Return a feature's number; None: it has none, or it is not to be had now."""
        if name not in self._nodes:
            return None
        try:
            value = await self._get(await self._begin(name), 0)
        except (FrameSourceError, MessageError):
            return None
        return None if isinstance(value, str) else value

    async def entries(self, name: str) -> dict[str, int]:
        """Return the entries of an enumeration that the camera has now, by name.

        Raises:
            FrameSourceError: there is no such enumeration.
        """
        node = await self._begin(name)
        try:
            return {
                entry.name: _whole(entry.text_of("Value"))
                for entry in node.all("EnumEntry")
                if await self._there(entry, 0)
            }
        except MessageError as exc:
            raise self._wrong(name, str(exc)) from exc

    async def set(self, name: str, value: Value) -> None:
        """Set a feature; a command is executed, whatever the value.

        Args:
            name: of the feature.
            value: as it is, or as text: an entry's name, ``true``, a number.

        Raises:
            FrameSourceError: there is none of that name, it cannot be set, or not to that.
        """
        node = await self._begin(name)
        try:
            if await self._condition(node, "pIsLocked", False, 0):
                raise self._wrong(name, "it is locked now")
            await self._set(node, await self._meant(node, value), 0)
        except MessageError as exc:
            raise self._wrong(name, str(exc)) from exc

    async def execute(self, name: str) -> None:
        """Execute a command.

        Raises:
            FrameSourceError: there is none of that name, or the camera refuses.
        """
        await self.set(name, 1)

    # helpers

    def _kind(self, name: str) -> str:
        node = self._nodes.get(name)
        return "" if node is None else node.kind

    def _wrong(self, name: str, text: str, available: tuple[str, ...] = ()) -> FrameSourceError:
        return FrameSourceError(
            f"{self._source}: feature {name}: {text}", source=self._source, available=available
        )

    async def _begin(self, name: str) -> Element:
        self._steps = 0
        self._read.clear()
        node = self._nodes.get(name)
        if node is None or node.kind in ("Category", "Port"):
            names = self.names()
            raise FrameSourceError(
                f"{self._source}: it has no feature {name!r}{did_you_mean(name, names)}; it has "
                f"{', '.join(names)}",
                source=self._source,
                available=tuple(names),
            )
        try:
            there = await self._there(node, 0)
        except MessageError as exc:
            raise self._wrong(name, str(exc)) from exc
        if not there:
            raise self._wrong(name, "it is not available now")
        return node

    async def _there(self, node: Element, depth: int) -> bool:
        implemented = await self._condition(node, "pIsImplemented", True, depth)
        return implemented and await self._condition(node, "pIsAvailable", True, depth)

    async def _condition(self, node: Element, kind: str, default: bool, depth: int) -> bool:
        found = node.first(kind)
        return default if found is None else bool(await self._numbered(found.text, depth + 1))

    async def _meant(self, node: Element, value: Value) -> Value:
        """Return what a value means to a node, once it is known to be one that it can have."""
        if node.kind == "Command":
            return int(await self._field(node, "CommandValue", 0, 1))
        if node.kind in _TEXTS:
            return str(value)
        if node.kind == "Boolean":
            said = str(value).lower()
            if said not in ("0", "1", "true", "false", "on", "off"):
                raise self._wrong(node.name, f"expected true or false, got {value!r}")
            return _on(node) if said in ("1", "true", "on") else _off(node)
        if node.kind == "Enumeration":
            entries = await self.entries(node.name)
            if str(value) not in entries:
                raise self._wrong(
                    node.name,
                    f"expected {', '.join(entries)}, got {str(value)!r}"
                    f"{did_you_mean(str(value), entries)}",
                    tuple(entries),
                )
            return entries[str(value)]
        number = _number(str(value)) if isinstance(value, str) else value
        if node.kind in _WHOLE and number != int(number):
            raise self._wrong(node.name, f"expected a whole number, got {value!r}")
        await self._within(node, number)
        return number

    async def _within(self, node: Element, number: float) -> None:
        least = await self._field(node, "Min", 0, -math.inf)
        most = await self._field(node, "Max", 0, math.inf)
        step = await self._field(node, "Inc", 0, 0) if node.kind == "Integer" else 0
        wrong_step = step > 1 and math.isfinite(least) and (number - least) % step
        if not least <= number <= most or wrong_step:
            steps = f" in steps of {step:g}" if step > 1 else ""
            raise self._wrong(
                node.name,
                f"expected {least:g} to {most:g}{steps}, got {number:g}",
                (f"{least:g} to {most:g}{steps}",),
            )

    # values

    async def _numbered(self, name: str, depth: int) -> int | float:
        """Return the number of the node of a name."""
        node = self._nodes.get(name)
        if node is None:
            raise MessageError(f"the description has no node {name[:80]!r}")
        value = await self._get(node, depth)
        if isinstance(value, str):
            raise MessageError(f"node {name}: expected a number, got text")
        return value

    async def _field(
        self, node: Element, kind: str, depth: int, default: float | None = None
    ) -> int | float:
        """Return the number of ``<kind>``, or of the node that ``<pkind>`` names."""
        for one in node.children:
            if one.kind == kind:
                return _number(one.text)
            if one.kind == "p" + kind:
                return await self._numbered(one.text, depth + 1)
        if default is None:
            raise MessageError(f"{node.kind} {node.name}: it has no <{kind}>")
        return default

    async def _get(self, node: Element, depth: int) -> Value:
        self._steps += 1
        if depth > DEEPEST or self._steps > MOST_STEPS:
            raise MessageError(f"node {node.name}: its description goes in a circle")
        if node.kind in _KNIVES:
            formula = node.text_of("Formula")
            return await self._worked_out(node, formula, {}, depth)
        if node.kind in _CONVERTERS:
            raw = await self._field(node, "Value", depth)
            return await self._worked_out(node, node.text_of("FormulaFrom"), {"TO": raw}, depth)
        if node.kind in _HOLDERS:
            return await self._get_held(node, depth)
        address, length = await self._place(node, depth)
        data = await self._bytes(address, length)
        if node.kind == "StringReg":
            return text(data)
        if node.kind == "FloatReg":
            return _float(node, data)
        return _bits(node, data)

    async def _get_held(self, node: Element, depth: int) -> Value:
        if node.name in self._held:
            return self._held[node.name]
        target = await self._target(node, depth)
        if target is not None:
            value = await self._get(target, depth + 1)
        elif node.kind == "String":
            value = node.text_of("Value")
        else:
            value = await self._field(node, "Value", depth)
        if node.kind in _WHOLE and isinstance(value, float):
            return int(value)
        return value

    async def _target(self, node: Element, depth: int) -> Element | None:
        """Return the node that has a node's value; None: it has it itself."""
        found = node.first("pValue")
        index = node.first("pIndex")
        if index is not None and node.kind in ("Integer", "Float"):
            wanted = await self._numbered(index.text, depth + 1)
            for one in node.all("pValueIndexed"):
                if _number(one.attributes.get("Index", "-1")) == wanted:
                    found = one
                    break
            else:
                found = node.first("pValueDefault") or found
        if found is None:
            return None
        target = self._nodes.get(found.text)
        if target is None:
            raise MessageError(f"{node.kind} {node.name}: there is no node {found.text[:80]!r}")
        return target

    async def _worked_out(
        self, node: Element, formula: str, variables: dict[str, int | float], depth: int
    ) -> int | float:
        """Return what a formula gives with the node's variables."""
        whole = node.kind.startswith("Int")
        for one in node.children:
            if one.kind == "pVariable":
                variables[one.name] = await self._variable(one, depth)
            elif one.kind == "Constant":
                variables[one.name] = _number(one.text)
            elif one.kind == "Expression":
                variables[one.name] = evaluate(one.text, variables, whole=whole)
        return evaluate(formula, variables, whole=whole)

    async def _variable(self, variable: Element, depth: int) -> int | float:
        _, _, what = variable.name.partition(".")
        if what in ("Min", "Max", "Inc"):
            node = self._nodes.get(variable.text)
            if node is not None:
                return await self._field(node, what, depth + 1)
        return await self._numbered(variable.text, depth + 1)

    async def _set(self, node: Element, value: Value, depth: int) -> None:
        self._steps += 1
        if depth > DEEPEST or self._steps > MOST_STEPS:
            raise MessageError(f"node {node.name}: its description goes in a circle")
        if node.kind in _KNIVES or node.text_of("AccessMode") == "RO":
            raise MessageError(f"{node.kind} {node.name} can only be read")
        if node.kind in _CONVERTERS:
            if isinstance(value, str):
                raise MessageError(f"{node.kind} {node.name}: expected a number, got text")
            formula = node.text_of("FormulaTo")
            value = await self._worked_out(node, formula, {"FROM": value}, depth)
        elif node.kind not in _HOLDERS:
            await self._write(node, value, depth)
            return
        target = await self._target(node, depth)
        if target is None:
            self._held[node.name] = value
            return
        if target.kind in _WHOLE and isinstance(value, float):
            value = round(value)
        if depth and target.kind in ("Integer", "Float") and not isinstance(value, str):
            await self._within(target, value)
        await self._set(target, value, depth + 1)

    # registers

    async def _place(self, node: Element, depth: int) -> tuple[int, int]:
        """Return a register's address and its length."""
        if node.first("pPort") is None:
            raise MessageError(f"{node.kind} {node.name} is no register of the camera")
        port = self._nodes.get(node.text_of("pPort"))
        if port is not None and port.first("ChunkID", "pChunkID") is not None:
            raise MessageError(f"{node.name} is sent with each frame only")
        length = int(await self._field(node, "Length", depth, 4))
        if not 0 < length <= LONGEST:
            raise MessageError(f"{node.kind} {node.name}: impossible length {length}")
        address = 0
        for one in node.children:
            if one.kind == "Address":
                address += _whole(one.text)
            elif one.kind == "pAddress":
                address += int(await self._numbered(one.text, depth + 1))
            elif one.kind == "IntSwissKnife":
                address += int(await self._get(one, depth + 1))
            elif one.kind == "pIndex":
                address += await self._index(one, length, depth)
        if not 0 <= address <= 0xFFFFFFFF - length:
            raise MessageError(f"{node.kind} {node.name}: impossible address {address:#x}")
        return address, length

    async def _index(self, index: Element, length: int, depth: int) -> int:
        offset: int | float = length
        if "Offset" in index.attributes:
            offset = _whole(index.attributes["Offset"])
        elif "pOffset" in index.attributes:
            offset = await self._numbered(index.attributes["pOffset"], depth + 1)
        return int(offset * await self._numbered(index.text, depth + 1))

    async def _bytes(self, address: int, length: int) -> bytes:
        """Read a register, once for each call from outside."""
        if (address, length) not in self._read:
            self._read[address, length] = await self._port.read(address, length)
        return self._read[address, length]

    async def _write(self, node: Element, value: Value, depth: int) -> None:
        address, length = await self._place(node, depth)
        if node.kind == "StringReg":
            data = str(value).encode()
            if len(data) > length:
                raise MessageError(f"expected at most {length} bytes, got {len(data)}")
            data = data.ljust(length, b"\0")
        elif isinstance(value, str):
            raise MessageError(f"{node.kind} {node.name}: expected a number, got text")
        elif node.kind == "FloatReg":
            data = struct.pack(_float_format(node, length), value)
        else:
            whole = round(value)
            shift, bits = _span(node, length)
            least = -(1 << bits - 1) if _signed(node) else 0
            if not least <= whole < least + (1 << bits):
                raise MessageError(f"{whole} has no room in {bits} bits")
            order = _order(node)
            if bits < 8 * length:
                before = int.from_bytes(await self._bytes(address, length), order)
                mask = (1 << bits) - 1 << shift
                whole = before & ~mask | whole << shift & mask
            data = (whole & (1 << 8 * length) - 1).to_bytes(length, order)
        self._read.clear()
        await self._port.write(address, data)


def _number(said: str) -> int | float:
    try:
        return _whole(said)
    except MessageError:
        pass
    try:
        number = float(said)
    except ValueError:
        number = math.nan
    if math.isnan(number):
        raise MessageError(f"expected a number, got {said[:40]!r}")
    return number


def _whole(said: str) -> int:
    digits = said.strip()
    try:
        if len(digits) > 24:
            raise ValueError("too long")
        number = int(digits, 16 if digits.lower().startswith("0x") else 10)
    except ValueError as exc:
        raise MessageError(f"expected a whole number, got {said[:40]!r}") from exc
    return number


def _entries(node: Element) -> dict[str, int]:
    return {entry.name: _whole(entry.text_of("Value")) for entry in node.all("EnumEntry")}


def _on(node: Element) -> int:
    return _whole(node.text_of("OnValue", "1"))


def _off(node: Element) -> int:
    return _whole(node.text_of("OffValue", "0"))


def _signed(node: Element) -> bool:
    return node.text_of("Sign") == "Signed"


def _order(node: Element) -> Literal["big", "little"]:
    return "big" if node.text_of("Endianess") == "BigEndian" else "little"


def _span(node: Element, length: int) -> tuple[int, int]:
    """Return how far the lowest bit of a node is shifted, and how many it has."""
    if node.kind == "IntReg":
        return 0, 8 * length
    bit = node.text_of("Bit")
    ends = [_whole(bit or node.text_of(kind)) for kind in ("LSB", "MSB")]
    low, high = min(ends), max(ends)
    if not 0 <= low <= high < 8 * length:
        raise MessageError(f"{node.kind} {node.name}: impossible bits {low} to {high}")
    if _order(node) == "big":  # where bit 0 is the highest one
        low = 8 * length - 1 - high
    return low, abs(ends[1] - ends[0]) + 1


def _bits(node: Element, data: bytes) -> int:
    shift, bits = _span(node, len(data))
    value = int.from_bytes(data, _order(node)) >> shift & (1 << bits) - 1
    return value - (1 << bits) if _signed(node) and value >> bits - 1 else value


def _float_format(node: Element, length: int) -> str:
    kinds = {4: "f", 8: "d"}
    if length not in kinds:
        raise MessageError(f"FloatReg {node.name}: expected 4 or 8 bytes, got {length}")
    return (">" if _order(node) == "big" else "<") + kinds[length]


def _float(node: Element, data: bytes) -> float:
    value: float = struct.unpack(_float_format(node, len(data)), data)[0]
    return value
