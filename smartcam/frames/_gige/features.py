"""Read and set a camera's features by name, as its GenICam description defines them.

Source: GenApi 2.0, chapter 2.8 (kinds of nodes and what their elements mean); SFNC (names).
"""

from __future__ import annotations

import asyncio
import math
import struct
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol, TypeVar

from smartcam._suggestions import did_you_mean
from smartcam.exceptions import FrameFeatureError, FrameSourceError, MessageError
from smartcam.frames._features import Feature, spelling_key
from smartcam.frames._gige.expressions import evaluate
from smartcam.frames._gige.gvcp import text

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Mapping

    from smartcam.frames._features import FeatureKind, FeatureValue
    from smartcam.frames._gige.description import Element

MAX_LINKED_NODES: Final = 64
"""Largest length of a chain of references between nodes; a longer one counts as a circle."""

MAX_NODES_VISITED: Final = 5000
"""Largest number of nodes that are visited for one value."""

MAX_ELEMENTS_VISITED: Final = 500_000
"""Largest number of elements of nodes and characters of formulas that are examined for one value,
which takes about a second. A node counts each time it is needed."""

MAX_REGISTER_BYTES: Final = 4096
"""Largest size of a register, bytes."""

_REGISTER_NODES: Final = ("IntReg", "MaskedIntReg", "StructEntry")
_FORMULA_NODES: Final = ("SwissKnife", "IntSwissKnife")
_CONVERTER_NODES: Final = ("Converter", "IntConverter")
_VALUE_NODES: Final = ("Integer", "Float", "Boolean", "Enumeration", "String", "Command")
_INTEGER_NODES: Final = (
    "Integer",
    "IntSwissKnife",
    "IntConverter",
    "Enumeration",
    "Boolean",
    *_REGISTER_NODES,
)
_TEXT_NODES: Final = ("String", "StringReg")
_KINDS: Final[Mapping[str, FeatureKind]] = {
    **dict.fromkeys(("Integer", "IntSwissKnife", "IntConverter", *_REGISTER_NODES), "integer"),
    **dict.fromkeys(("Float", "FloatReg", "SwissKnife", "Converter"), "float"),
    **dict.fromkeys(_TEXT_NODES, "string"),
    "Boolean": "boolean",
    "Enumeration": "enumeration",
    "Command": "command",
}
"""Kinds of features by the kind of node."""

MAX_DESCRIPTION_CHARACTERS: Final = 1000
"""Largest number of characters of a feature's description; the rest is cut."""

T = TypeVar("T")


class NoLimitError(MessageError):
    """Error for a node without limits in the description."""


class DeviceMemory(Protocol):
    """The camera's memory."""

    async def read(self, address: int, length: int) -> bytes:
        """Return ``length`` bytes, beginning at an address."""
        ...

    async def write(self, address: int, data: bytes) -> None:
        """Write bytes, beginning at an address."""
        ...


class GenicamFeatures:
    """The features of a camera, to read and to set.

    No value is kept between two calls, except values that the description itself holds.

    Args:
        nodes: named elements of the camera's description.
        port: memory of the camera.
        source: name of the camera, for errors.
    """

    def __init__(self, nodes: Mapping[str, Element], port: DeviceMemory, source: str) -> None:
        self._nodes, self._port, self._source = nodes, port, source
        self._own_values: dict[str, FeatureValue] = {}  # values set for nodes with a <Value>
        self._register_cache: dict[tuple[str, int, int], bytes] = {}
        self._visited_nodes = self._examined_elements = 0
        self._before_write: Callable[[], None] | None = None
        self._lock = asyncio.Lock()  # guards the caches of a call
        self._spellings = {spelling_key(name): name for name in nodes}
        self._selectors: dict[str, tuple[str, ...]] | None = None

    def share_description(self, other: GenicamFeatures) -> None:
        """Share another object's description, and the values that were set in it."""
        GenicamFeatures.__init__(self, other._nodes, other._port, other._source)
        self._own_values = other._own_values

    def __contains__(self, name: object) -> bool:
        """Return True if the description has a node of this name."""
        return name in self._nodes

    def names(self) -> list[str]:
        """Return the names of the features in the description's categories."""
        listed = [
            feature.text
            for node in self._nodes.values()
            if node.kind == "Category"
            for feature in node.all("pFeature")
        ]
        return sorted({name for name in listed if self._kind(name) not in ("", "Category")})

    def find(self, name: str) -> str:
        """Return the description's spelling of a name; an unknown name is returned unchanged."""
        return name if name in self._nodes else self._spellings.get(spelling_key(name), name)

    async def get(self, name: str) -> FeatureValue:
        """Return a feature's value; for an enumeration, the entry's name.

        Raises:
            FrameFeatureError: there is no feature of that name, it is not available now, or has no
                value.
        """
        async with self._lock:
            node = await self._available_node(name)
            try:
                return await self._as_user_value(node)
            except MessageError as exc:
                raise self._feature_error(name, str(exc)) from exc

    async def number(self, name: str) -> float | None:
        """Return a feature's number; None if it is no number, or not available now."""
        if name not in self._nodes:
            return None
        async with self._lock:
            try:
                value = await self._get_value(await self._available_node(name), 0)
            except (FrameSourceError, MessageError):
                return None
        return None if isinstance(value, str) else value

    async def entries(self, name: str) -> dict[str, int]:
        """Return the entries of an enumeration that are available now, by name.

        Raises:
            FrameFeatureError: there is no such enumeration.
        """
        async with self._lock:
            node = await self._available_node(name)
            try:
                return await self._entries_now(node)
            except MessageError as exc:
                raise self._feature_error(name, str(exc)) from exc

    async def set(
        self, name: str, value: FeatureValue, *, before_write: Callable[[], None] | None = None
    ) -> None:
        """Set a feature; a command is executed, whatever the value.

        Args:
            name: name of the feature.
            value: value of the feature, or its text: an entry's name, ``true``, a number.
            before_write: function that is called right before the camera's register is written.

        Raises:
            FrameFeatureError: there is no such feature, it cannot be set, or the value is out of
                range.
        """
        async with self._lock:
            node = await self._available_node(name)
            self._before_write = before_write
            try:
                if await self._condition(node, "pIsLocked", False, 0):
                    raise self._feature_error(name, "it is locked now")
                await self._set_value(node, await self._as_node_value(node, value), 0)
            except MessageError as exc:
                raise self._feature_error(name, str(exc)) from exc
            finally:
                self._before_write = None

    async def execute(self, name: str, *, before_write: Callable[[], None] | None = None) -> None:
        """Start a command; the camera may still be executing it afterwards.

        Args:
            name: name of the command.
            before_write: function that is called right before the camera's register is written.

        Raises:
            FrameFeatureError: there is no command of that name, or the camera refuses.
        """
        await self.set(name, 1, before_write=before_write)

    def check_command(self, name: str, *, is_command: bool = True) -> None:
        """Raise unless a name belongs to a command; with ``is_command`` False, raise if it does.

        Raises:
            FrameSourceError: the feature is of the other kind, or there is no such feature.
        """
        node = self._find_node(name)
        if (node.kind == "Command") != is_command:
            text = "it is no command: set it" if is_command else "it is a command: execute it"
            raise self._feature_error(node.name, text)

    async def is_done(self, name: str) -> bool:
        """Return True if a command is done: its register no longer has the command's value.

        A command with an unreadable register is done when the camera answers the write.

        Raises:
            FrameSourceError: the camera does not answer.
        """
        async with self._lock:
            node = await self._available_node(name)
            try:
                command = await self._number_field(node, "CommandValue", 0, 1)
                return await self._get_value_field(node, 0) != command
            except MessageError:
                return True

    async def describe(self, name: str) -> Feature:
        """Return a feature with its present value, range and access.

        Raises:
            FrameFeatureError: there is no feature of that name, or the camera does not answer.
        """
        async with self._lock:
            node = self._find_node(name)
            return await self._describe_node(node)

    # helpers

    def _kind(self, name: str) -> str:
        node = self._nodes.get(name)
        return "" if node is None else node.kind

    def _feature_error(
        self, name: str, text: str, available: tuple[str, ...] = ()
    ) -> FrameFeatureError:
        return FrameFeatureError(
            f"{self._source}: feature {name}: {text}", source=self._source, available=available
        )

    def _find_node(self, name: str) -> Element:
        self._visited_nodes = self._examined_elements = 0
        self._register_cache.clear()
        node = self._nodes.get(self.find(name))
        if node is None or node.kind in ("Category", "Port"):
            names = self.names()
            raise FrameFeatureError(
                f"{self._source}: it has no feature {name!r}{did_you_mean(name, names)}; it has "
                f"{', '.join(names)}",
                source=self._source,
                available=tuple(names),
            )
        return node

    async def _available_node(self, name: str) -> Element:
        node = self._find_node(name)
        try:
            available = await self._is_available(node, 0)
        except MessageError as exc:
            raise self._feature_error(name, str(exc)) from exc
        if not available:
            raise self._feature_error(name, "it is not available now")
        return node

    async def _is_available(self, node: Element, depth: int) -> bool:
        implemented = await self._condition(node, "pIsImplemented", True, depth)
        return implemented and await self._condition(node, "pIsAvailable", True, depth)

    async def _condition(self, node: Element, kind: str, default: bool, depth: int) -> bool:
        child = node.first(kind)
        return default if child is None else bool(await self._node_number(child.text, depth + 1))

    async def _entries_now(self, node: Element) -> dict[str, int]:
        return {
            entry.name: _integer(entry.text_of("Value"))
            for entry in node.all("EnumEntry")
            if await self._is_available(entry, 0)
        }

    async def _as_user_value(self, node: Element) -> FeatureValue:
        """Return a node's value in the user's form."""
        value = await self._get_value(node, 0)
        if node.kind == "Enumeration":
            return next((name for name, entry in _entries(node).items() if entry == value), value)
        if node.kind == "Boolean":
            return value == _on_value(node)
        return value

    async def _as_node_value(self, node: Element, value: FeatureValue) -> FeatureValue:
        """Convert a user's value to the node's form; raise if the node cannot have it."""
        if node.kind == "Command":
            return int(await self._number_field(node, "CommandValue", 0, 1))
        if node.kind in _TEXT_NODES:
            return str(value)
        if node.kind == "Boolean":
            text = str(value).lower()
            if text not in ("0", "1", "true", "false", "on", "off"):
                raise self._feature_error(node.name, f"expected true or false, got {value!r}")
            return _on_value(node) if text in ("1", "true", "on") else _off_value(node)
        if node.kind == "Enumeration":
            entries = await self._entries_now(node)
            if str(value) not in entries:
                raise self._feature_error(
                    node.name,
                    f"expected {', '.join(entries)}, got {str(value)!r}"
                    f"{did_you_mean(str(value), entries)}",
                    tuple(entries),
                )
            return entries[str(value)]
        number = _number(str(value)) if isinstance(value, str) else value
        if node.kind in _INTEGER_NODES and number != int(number):
            raise self._feature_error(node.name, f"expected a whole number, got {value!r}")
        await self._check_range(node, number)
        return number

    async def _check_range(self, node: Element, number: float) -> None:
        minimum = await self._number_field(node, "Min", 0, -math.inf)
        maximum = await self._number_field(node, "Max", 0, math.inf)
        step = await self._number_field(node, "Inc", 0, 0) if node.kind == "Integer" else 0
        wrong_step = step > 1 and math.isfinite(minimum) and (number - minimum) % step
        if not minimum <= number <= maximum or wrong_step:
            steps = f" in steps of {step:g}" if step > 1 else ""
            raise self._feature_error(
                node.name,
                f"expected {minimum:g} to {maximum:g}{steps}, got {number:g}",
                (f"{minimum:g} to {maximum:g}{steps}",),
            )

    # values

    async def _node_number(self, name: str, depth: int) -> int | float:
        """Return the number of a named node."""
        node = self._nodes.get(name)
        if node is None:
            raise MessageError(f"the description has no node {name[:80]!r}")
        value = await self._get_value(node, depth)
        if isinstance(value, str):
            raise MessageError(f"node {name}: expected a number, got text")
        return value

    async def _number_field(
        self, node: Element, kind: str, depth: int, default: float | None = None
    ) -> int | float:
        """Return the number in ``<kind>``, or of the node named in ``<pKind>``."""
        for child in node.children:
            if child.kind == kind:
                return _number(child.text)
            if child.kind == "p" + kind:
                return await self._node_number(child.text, depth + 1)
        if default is None:
            raise MessageError(f"{node.kind} {node.name}: it has no <{kind}>")
        return default

    def _count_node(self, node: Element, depth: int) -> None:
        """Count a visited node; raise MessageError beyond the limits of depth and number."""
        self._visited_nodes += 1
        if depth > MAX_LINKED_NODES or self._visited_nodes > MAX_NODES_VISITED:
            raise MessageError(f"node {node.name}: it depends on itself, or on too many nodes")
        self._count_elements(node, len(node.children))

    def _count_elements(self, node: Element, work: int) -> None:
        """Count examined elements or characters; raise MessageError beyond the limit."""
        self._examined_elements += work
        if self._examined_elements > MAX_ELEMENTS_VISITED:
            raise MessageError(
                f"node {node.name}: expected at most {MAX_ELEMENTS_VISITED} elements and "
                "characters of formulas for one value, got more"
            )

    async def _get_value(self, node: Element, depth: int) -> FeatureValue:
        self._count_node(node, depth)
        if "WO" in _access(node):
            raise MessageError(f"{node.kind} {node.name} can only be written")
        if node.kind in _FORMULA_NODES:
            formula = node.text_of("Formula")
            return await self._evaluate(node, formula, {}, depth)
        if node.kind in _CONVERTER_NODES:
            raw = await self._number_field(node, "Value", depth)
            return await self._evaluate(node, node.text_of("FormulaFrom"), {"TO": raw}, depth)
        if node.kind in _VALUE_NODES:
            return await self._get_value_field(node, depth)
        data = await self._read_register(node, *await self._register_location(node, depth))
        if node.kind == "StringReg":
            return text(data)
        if node.kind == "FloatReg":
            return _float(node, data)
        return _bits(node, data)

    async def _get_value_field(self, node: Element, depth: int) -> FeatureValue:
        if node.name in self._own_values:
            return self._own_values[node.name]
        target = await self._value_node(node, depth)
        if target is not None:
            value = await self._get_value(target, depth + 1)
            if node.kind == "Integer" and target.kind not in (*_INTEGER_NODES, "Command"):
                raise MessageError(
                    f"Integer {node.name}: expected a node of whole numbers as its pValue, got the "
                    f"{target.kind} {target.name}"
                )
        elif node.kind == "String":
            value = node.text_of("Value")
        elif node.first("pIndex") is not None:
            value = await self._indexed(node, depth)
        else:
            value = await self._number_field(node, "Value", depth)
        if node.kind in _INTEGER_NODES and isinstance(value, float):
            return int(value)
        return value

    async def _indexed(self, node: Element, depth: int) -> int | float:
        """Return the number that the description gives for the present value of an index."""
        index_value = await self._node_number(node.text_of("pIndex"), depth + 1)
        for child in node.all("ValueIndexed"):
            if _number(child.attributes.get("Index", "-1")) == index_value:
                return _number(child.text)
        return await self._number_field(node, "ValueDefault", depth)

    async def _value_node(self, node: Element, depth: int) -> Element | None:
        """Return the other node that holds a node's value; None: the node holds it itself."""
        element = node.first("pValue")
        index = node.first("pIndex")
        if index is not None and node.kind in ("Integer", "Float"):
            index_value = await self._node_number(index.text, depth + 1)
            for child in node.all("pValueIndexed"):
                if _number(child.attributes.get("Index", "-1")) == index_value:
                    element = child
                    break
            else:
                has_value = index_value in [
                    _number(child.attributes.get("Index", "-1"))
                    for child in node.all("ValueIndexed")
                ]
                element = None if has_value else node.first("pValueDefault") or element
        if element is None:
            return None
        target = self._nodes.get(element.text)
        if target is None:
            raise MessageError(f"{node.kind} {node.name}: there is no node {element.text[:80]!r}")
        return target

    async def _evaluate(
        self, node: Element, formula: str, variables: dict[str, int | float], depth: int
    ) -> int | float:
        """Evaluate a formula with the node's variables."""
        integers = node.kind.startswith("Int")
        self._count_elements(node, len(formula))
        for child in node.children:
            if child.kind == "pVariable":
                variables[child.name] = await self._variable(child, depth)
            elif child.kind == "Constant":
                variables[child.name] = _number(child.text)
            elif child.kind == "Expression":
                self._count_elements(node, len(child.text))
                variables[child.name] = evaluate(child.text, variables, integers=integers)
        return evaluate(formula, variables, integers=integers)

    async def _variable(self, variable: Element, depth: int) -> int | float:
        """Return the value of a formula's variable: of its node, or of the node's ``.NAME``."""
        _, _, property_ = variable.name.partition(".")
        if property_ in ("", "Value"):
            return await self._node_number(variable.text, depth + 1)
        node = self._nodes.get(variable.text)
        if node is None:
            raise MessageError(f"the description has no node {variable.text[:80]!r}")
        if property_ in ("Min", "Max", "Inc"):
            return await self._limit(node, property_, depth + 1)
        kind, _, entry = property_.partition(".")
        if kind == "Entry":
            entries = _entries(node)
            if entry not in entries:
                raise MessageError(
                    f"{node.kind} {node.name}: it has no entry {entry[:40]!r}"
                    f"{did_you_mean(entry, entries)}"
                )
            return entries[entry]
        raise MessageError(
            f"variable {variable.name[:80]!r}: expected .Value, .Min, .Max, .Inc or .Entry.NAME "
            "after its name"
        )

    async def _limit(self, node: Element, bound: str, depth: int) -> int | float:
        """Return the smallest or largest value of a node, or its step.

        A node without limits has the limits of the node that holds its value; without these, they
        follow from its bits (GenApi 2.0, 2.8.4 and 2.8.6).
        """
        self._count_node(node, depth)
        if node.first(bound, "p" + bound) is not None:
            return await self._number_field(node, bound, depth)
        can_link = node.kind in ("Integer", "Float", "Enumeration")
        target = await self._value_node(node, depth) if can_link else None
        if target is not None:
            return await self._limit(target, bound, depth + 1)
        if bound == "Inc" and node.kind in _INTEGER_NODES:
            return 1
        if node.kind in ("Float", "FloatReg") and bound != "Inc":
            return -sys.float_info.max if bound == "Min" else sys.float_info.max
        if node.kind in ("Integer", "IntSwissKnife", "Enumeration") and bound != "Inc":
            return -(1 << 63) if bound == "Min" else (1 << 63) - 1
        if node.kind in _REGISTER_NODES and bound != "Inc":
            _, length = await self._register_location(node, depth)
            _, bits = _bit_range(node, length)
            sign_bits = int(_is_signed(node))
            return -(1 << bits - 1) * sign_bits if bound == "Min" else (1 << bits - sign_bits) - 1
        raise NoLimitError(f"{node.kind} {node.name}: it has no <{bound}>")

    async def _set_value(self, node: Element, value: FeatureValue, depth: int) -> None:
        self._count_node(node, depth)
        if node.kind in _FORMULA_NODES or "RO" in _access(node):
            raise MessageError(f"{node.kind} {node.name} can only be read")
        if node.kind in _CONVERTER_NODES:
            if isinstance(value, str):
                raise MessageError(f"{node.kind} {node.name}: expected a number, got text")
            formula = node.text_of("FormulaTo")
            value = await self._evaluate(node, formula, {"FROM": value}, depth)
        elif node.kind not in _VALUE_NODES:
            await self._write_register(node, value, depth)
            return
        target = await self._value_node(node, depth)
        if target is None:
            self._own_values[node.name] = value
            return
        if target.kind in _INTEGER_NODES and isinstance(value, float):
            value = round(value)
        if depth and target.kind in ("Integer", "Float") and not isinstance(value, str):
            await self._check_range(target, value)
        await self._set_value(target, value, depth + 1)
        for copy in node.all("pValueCopy"):
            other = self._nodes.get(copy.text)
            if other is None:
                raise MessageError(f"{node.kind} {node.name}: there is no node {copy.text[:80]!r}")
            await self._set_value(other, value, depth + 1)

    # descriptions

    async def _describe_node(self, node: Element) -> Feature:
        kind = _KINDS.get(node.kind)
        if kind is None:
            raise self._feature_error(node.name, f"a {node.kind} cannot be read or set")
        description = node.text_of("Description") or node.text_of("ToolTip")
        basis = Feature(
            node.name,
            kind,
            "",
            selectors=self._selectors_of(node.name),
            description=" ".join(description.split())[:MAX_DESCRIPTION_CHARACTERS],
        )
        problems: list[str] = []
        try:
            access = await self._access_now(node)
            if not access:
                return basis
        except MessageError as exc:
            return replace(basis, problem=str(exc))
        attributes: dict[str, Any] = {"access": access, "unit": await self._unit(node, problems)}
        if kind == "enumeration":
            attributes["entries"] = tuple(
                await self._result_or_problem(self._entries_now(node), problems) or ()
            )
        elif kind in ("integer", "float"):
            for attribute, bound in (("minimum", "Min"), ("maximum", "Max"), ("step", "Inc")):
                if bound == "Inc" and kind == "float":
                    continue
                limit = await self._result_or_problem(self._limit(node, bound, 0), problems)
                is_unlimited = limit is None or abs(limit) >= (
                    sys.float_info.max if kind == "float" else (1 << 63) - 1
                )
                attributes[attribute] = None if is_unlimited else limit
        if kind != "command" and access != "wo":
            attributes["value"] = await self._result_or_problem(self._as_user_value(node), problems)
        return replace(basis, **attributes, problem="; ".join(dict.fromkeys(problems)))

    async def _result_or_problem(
        self, work: Coroutine[Any, Any, T], problems: list[str]
    ) -> T | None:
        """Return the result of ``work``; if it fails, add the problem to the list, return None."""
        self._visited_nodes = self._examined_elements = 0
        try:
            return await work
        except NoLimitError:
            return None
        except (MessageError, FrameSourceError) as exc:
            if isinstance(exc, TimeoutError):
                raise
            problems.append(str(exc))
            return None

    async def _access_now(self, node: Element) -> Literal["rw", "ro", "wo", ""]:
        """Return the present access to a feature."""
        if not await self._is_available(node, 0):
            return ""
        readable, writable = True, not await self._condition(node, "pIsLocked", False, 0)
        for depth in range(MAX_LINKED_NODES):
            modes = _access(node)
            readable = readable and "WO" not in modes
            writable = writable and "RO" not in modes and node.kind not in _FORMULA_NODES
            target = None
            if node.kind in (*_VALUE_NODES, *_CONVERTER_NODES):
                target = await self._value_node(node, depth)
            if target is None:
                break
            node = target
            if not await self._is_available(node, depth):
                return ""
            writable = writable and not await self._condition(node, "pIsLocked", False, depth)
        return ("rw" if writable else "ro") if readable else "wo" if writable else ""

    async def _unit(self, node: Element, problems: list[str]) -> str:
        """Return the unit of a node, or of the node that holds its value."""
        for depth in range(MAX_LINKED_NODES):
            unit = node.text_of("Unit")
            if unit or node.kind not in ("Integer", "Float"):
                return unit
            target = await self._result_or_problem(self._value_node(node, depth), problems)
            if target is None:
                return ""
            node = target
        return ""

    def _selectors_of(self, name: str) -> tuple[str, ...]:
        """Return the features that select which instance of a feature is meant."""
        if self._selectors is None:
            selectors: dict[str, list[str]] = {}
            for node in self._nodes.values():
                for child in node.all("pSelected"):
                    selectors.setdefault(child.text, []).append(node.name)
            self._selectors = {selected: tuple(names) for selected, names in selectors.items()}
        return self._selectors.get(name, ())

    # registers

    async def _register_location(self, node: Element, depth: int) -> tuple[int, int]:
        """Return a register's address and its length."""
        if node.first("pPort") is None:
            raise MessageError(f"{node.kind} {node.name} is no register of the camera")
        length = int(await self._number_field(node, "Length", depth, 4))
        if not 0 < length <= MAX_REGISTER_BYTES:
            raise MessageError(f"{node.kind} {node.name}: impossible length {length}")
        address = 0
        for child in node.children:
            if child.kind == "Address":
                address += _integer(child.text)
            elif child.kind == "pAddress":
                address += int(await self._node_number(child.text, depth + 1))
            elif child.kind == "IntSwissKnife":
                address += int(await self._get_value(child, depth + 1))
            elif child.kind == "pIndex":
                address += await self._index_offset(child, length, depth)
        if not 0 <= address <= 0xFFFFFFFF - length:
            raise MessageError(f"{node.kind} {node.name}: impossible address {address:#x}")
        return address, length

    async def _index_offset(self, index: Element, length: int, depth: int) -> int:
        offset: int | float = length
        if "Offset" in index.attributes:
            offset = _integer(index.attributes["Offset"])
        elif "pOffset" in index.attributes:
            offset = await self._node_number(index.attributes["pOffset"], depth + 1)
        return int(offset * await self._node_number(index.text, depth + 1))

    def _memory(self, node: Element) -> DeviceMemory:
        """Return the memory of a register."""
        port = self._nodes.get(node.text_of("pPort"))
        if port is not None and port.first("ChunkID", "pChunkID") is not None:
            raise MessageError(f"{node.name} is sent with each frame only")
        if port is not None and port.first("EventID") is not None:
            raise MessageError(f"{node.name} is sent with an event only")
        return self._port

    async def _read_register(self, node: Element, address: int, length: int) -> bytes:
        """Read a register, at most once per public call."""
        key = node.text_of("pPort"), address, length
        if key not in self._register_cache:
            self._register_cache[key] = await self._memory(node).read(address, length)
        return self._register_cache[key]

    async def _write_register(self, node: Element, value: FeatureValue, depth: int) -> None:
        address, length = await self._register_location(node, depth)
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
            number = round(value)
            shift, bits = _bit_range(node, length)
            minimum = -(1 << bits - 1) if _is_signed(node) else 0
            if not minimum <= number < minimum + (1 << bits):
                raise MessageError(f"{number} does not fit into {bits} bits")
            order = _byte_order(node)
            if bits < 8 * length:
                old = int.from_bytes(await self._read_register(node, address, length), order)
                mask = (1 << bits) - 1 << shift
                number = old & ~mask | number << shift & mask
            data = (number & (1 << 8 * length) - 1).to_bytes(length, order)
        memory = self._memory(node)
        self._register_cache.clear()
        if self._before_write is not None:
            self._before_write()
        await memory.write(address, data)


def _number(text: str) -> int | float:
    try:
        return _integer(text)
    except MessageError:
        pass
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if math.isnan(number):
        raise MessageError(f"expected a number, got {text[:40]!r}")
    return number


def _integer(text: str) -> int:
    digits = text.strip()
    try:
        if len(digits) > 24:
            raise ValueError("too long")
        number = int(digits, 16 if digits.lower().startswith("0x") else 10)
    except ValueError as exc:
        raise MessageError(f"expected a whole number, got {text[:40]!r}") from exc
    return number


def _entries(node: Element) -> dict[str, int]:
    return {entry.name: _integer(entry.text_of("Value")) for entry in node.all("EnumEntry")}


def _access(node: Element) -> tuple[str, str]:
    """Return the access mode of a node, and the mode that the description imposes."""
    return node.text_of("AccessMode"), node.text_of("ImposedAccessMode")


def _on_value(node: Element) -> int:
    return _integer(node.text_of("OnValue", "1"))


def _off_value(node: Element) -> int:
    return _integer(node.text_of("OffValue", "0"))


def _is_signed(node: Element) -> bool:
    return node.text_of("Sign") == "Signed"


def _byte_order(node: Element) -> Literal["big", "little"]:
    return "big" if node.text_of("Endianess") == "BigEndian" else "little"


def _bit_range(node: Element, length: int) -> tuple[int, int]:
    """Return the position of a node's lowest bit in its register, and its number of bits."""
    if node.kind == "IntReg":
        return 0, 8 * length
    bit = node.text_of("Bit")
    ends = [_integer(bit or node.text_of(kind)) for kind in ("LSB", "MSB")]
    low, high = min(ends), max(ends)
    if not 0 <= low <= high < 8 * length:
        raise MessageError(f"{node.kind} {node.name}: impossible bits {low} to {high}")
    if _byte_order(node) == "big":  # bit 0 is the highest bit
        low = 8 * length - 1 - high
    return low, abs(ends[1] - ends[0]) + 1


def _bits(node: Element, data: bytes) -> int:
    shift, bits = _bit_range(node, len(data))
    value = int.from_bytes(data, _byte_order(node)) >> shift & (1 << bits) - 1
    return value - (1 << bits) if _is_signed(node) and value >> bits - 1 else value


def _float_format(node: Element, length: int) -> str:
    kinds = {4: "f", 8: "d"}
    if length not in kinds:
        raise MessageError(f"FloatReg {node.name}: expected 4 or 8 bytes, got {length}")
    return (">" if _byte_order(node) == "big" else "<") + kinds[length]


def _float(node: Element, data: bytes) -> float:
    value: float = struct.unpack(_float_format(node, len(data)), data)[0]
    return value
