"""Read the nodeset of OPC 40100-1: its types, and the transitions of its state machines."""

from __future__ import annotations

import functools
import gzip
import importlib.resources
from typing import TYPE_CHECKING, NamedTuple
from xml.etree import ElementTree as ET

if TYPE_CHECKING:
    from collections.abc import Mapping

URI = "http://opcfoundation.org/UA/MachineVision"
"""Namespace of the nodeset."""

VISION = "VisionStateMachineType"
"""Name of the type of the state machine of a whole vision system."""

AUTOMATIC = "VisionAutomaticModeStateMachineType"
"""Name of the type of the state machine for jobs."""

_NODE = "{http://opcfoundation.org/UA/2011/03/UANodeSet.xsd}"


class Transition(NamedTuple):
    """A transition of a state machine.

    Attributes:
        machine: name of the machine's type.
        name: name of the transition.
        node: numeric id of the transition's node.
        source: name of the state before the transition.
        target: name of the state after the transition.
        cause: name of the method that causes the transition; "" without a method.
        effects: names of the types of the events that the transition raises.
    """

    machine: str
    name: str
    node: int
    source: str
    target: str
    cause: str
    effects: tuple[str, ...]


@functools.cache
def nodeset_text() -> str:
    """Return the nodeset as XML."""
    file = importlib.resources.files(__package__) / "MachineVision.NodeSet2.xml.gz"
    return gzip.decompress(file.read_bytes()).decode()


@functools.cache
def _nodes() -> Mapping[str, ET.Element]:
    root = ET.fromstring(nodeset_text())  # noqa: S314 - a file of this package
    return {element.attrib["NodeId"]: element for element in root if "NodeId" in element.attrib}


def _name(node: ET.Element) -> str:
    return node.attrib["BrowseName"].rpartition(":")[2]


@functools.cache
def node_ids() -> Mapping[str, int]:
    """Return the numeric ids of all types of the nodeset, by their names."""
    kinds = ("UAObjectType", "UAVariableType", "UADataType")
    wanted = {_NODE + kind for kind in kinds}
    return {_name(node): _number(key) for key, node in _nodes().items() if node.tag in wanted}


@functools.cache
def state_ids() -> Mapping[tuple[str, str], int]:
    """Return the numeric ids of states, by the name of the machine's type and the state's name."""
    ids: dict[tuple[str, str], int] = {}
    for transition in transitions():
        for name, key in _end_states(_nodes()[f"ns=1;i={transition.node}"]):
            ids[_machine(_nodes()[key]), name] = _number(key)
    return ids


@functools.cache
def transitions() -> tuple[Transition, ...]:
    """Return the transitions of both state machines."""
    parsed: list[Transition] = []
    for key, node in _nodes().items():
        states = [name for name, _ in _end_states(node)]
        machine = _machine(node)
        if len(states) == 2 and machine in (VISION, AUTOMATIC):
            causes = [_name(_nodes()[reference]) for reference in _references(node, "HasCause")]
            effects = tuple(
                _name(_nodes()[reference]) for reference in _references(node, "HasEffect")
            )
            source, target = states
            cause = causes[0] if causes else ""
            transition = Transition(
                machine, _name(node), _number(key), source, target, cause, effects
            )
            parsed.append(transition)
    return tuple(parsed)


def _end_states(node: ET.Element) -> list[tuple[str, str]]:
    """Return names and ids of a transition's two states; empty for other nodes."""
    keys = [*_references(node, "FromState"), *_references(node, "ToState")]
    return [(_name(_nodes()[key]), key) for key in keys]


def _references(node: ET.Element, kind: str) -> list[str]:
    references = node.iterfind(f"{_NODE}References/{_NODE}Reference")
    return [
        reference.text or ""
        for reference in references
        if reference.get("ReferenceType") == kind and reference.get("IsForward") != "false"
    ]


def _machine(node: ET.Element) -> str:
    parent = _nodes().get(node.get("ParentNodeId", ""))
    return "" if parent is None else _name(parent)


def _number(key: str) -> int:
    return int(key.rpartition("=")[2])
