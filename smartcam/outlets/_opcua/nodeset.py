"""The nodeset of OPC 40100-1: its text, and the transitions of its state machines."""

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
"""Name of the type of the state machine of jobs."""

_NODE = "{http://opcfoundation.org/UA/2011/03/UANodeSet.xsd}"


class Transition(NamedTuple):
    """A transition of a state machine.

    Attributes:
        machine: name of the machine's type.
        name: name of the transition.
        node: numeric id of its node.
        source: name of the state before it.
        target: name of the state after it.
        cause: name of the method that causes the transition; "" without a method.
        effects: names of the types of the events that it raises.
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
    """Return the numeric ids of states, by the names of their machine's type and their own."""
    ids: dict[tuple[str, str], int] = {}
    for transition in transitions():
        for name, key in _ends(_nodes()[f"ns=1;i={transition.node}"]):
            ids[_machine(_nodes()[key]), name] = _number(key)
    return ids


@functools.cache
def transitions() -> tuple[Transition, ...]:
    """Return the transitions of both machines, from the XML."""
    parsed: list[Transition] = []
    for key, node in _nodes().items():
        ends = [name for name, _ in _ends(node)]
        machine = _machine(node)
        if len(ends) == 2 and machine in (VISION, AUTOMATIC):
            causes = [_name(_nodes()[reference]) for reference in _refers(node, "HasCause")]
            effects = tuple(_name(_nodes()[reference]) for reference in _refers(node, "HasEffect"))
            source, target = ends
            cause = causes[0] if causes else ""
            made = Transition(machine, _name(node), _number(key), source, target, cause, effects)
            parsed.append(made)
    return tuple(parsed)


def _ends(node: ET.Element) -> list[tuple[str, str]]:
    """Return names and ids of a transition's states; empty for other nodes."""
    keys = [*_refers(node, "FromState"), *_refers(node, "ToState")]
    return [(_name(_nodes()[key]), key) for key in keys]


def _refers(node: ET.Element, kind: str) -> list[str]:
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
