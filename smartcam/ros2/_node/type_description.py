"""Serve descriptions of types by their hash: the service ``~/get_type_description``.

As in ``node.c`` of rcl: only the hash is compared, and only types that the node uses are described.
Nodes have the service from Iron on, the first distribution with hashes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam.ros2._types.hash import description, service_of
from smartcam.ros2._types.stores import WITHOUT_HASHES

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from smartcam.ros2._node.interface import NodeOfRos
    from smartcam.ros2._node.tokens import Entity
    from smartcam.ros2._types.types import RosTypes

TYPE = "type_description_interfaces/srv/GetTypeDescription"
PARAMETER = "start_type_description_service"
PREFIX = "RIHS01_"
DIGITS = 64


class TypeDescriptions:
    """Serves descriptions of the types that a node uses.

    Args:
        node: node that uses the types.
        entities: function that returns the node's current entries in the graph.
    """

    def __init__(self, node: NodeOfRos, entities: Callable[[], Iterable[Entity]]) -> None:
        self._node, self._entities = node, entities
        self._descriptions: dict[str, Any] = {}
        if served(node.types):
            node.parameters.declare(
                PARAMETER,
                True,
                description="Whether ~/get_type_description is served.",
                read_only=True,
            )

    def open(self) -> None:
        """Serve, if the distribution's nodes do."""
        if served(self._node.types):
            self._node.serve("~/get_type_description", TYPE, self._describe)

    async def _describe(self, request: Any) -> dict[str, Any]:
        wanted_hash = request.type_hash
        if not wanted_hash.startswith(PREFIX) or len(wanted_hash) != len(PREFIX) + DIGITS:
            return _failed(f"{wanted_hash!r:.100} is no hash: expected RIHS01_ and {DIGITS} digits")
        for entity in self._entities():
            if entity.hash == wanted_hash:
                break
        else:
            return _failed(f"{self._node.full_name} uses no type with the hash {wanted_hash}")
        made = self._descriptions.get(wanted_hash)
        if made is None:
            made = self._descriptions[wanted_hash] = describe(self._node.types, entity.ros_type)
        sources = self._sources(made) if request.include_type_sources else []
        return {"successful": True, "type_description": made, "type_sources": sources}

    def _sources(self, described: Any) -> list[dict[str, str]]:
        """Return the texts of the files of a type and of all nested types."""
        types = (described.type_description, *described.referenced_type_descriptions)
        return [self._source(kind.type_name) for kind in types]

    def _source(self, name: str) -> dict[str, str]:
        encoding, text = self._node.types.source(name)
        return {"type_name": name, "encoding": encoding, "raw_file_contents": text}


def served(types: RosTypes) -> bool:
    """Return True if nodes of the distribution serve the descriptions."""
    return types.distribution not in WITHOUT_HASHES


def describe(types: RosTypes, name: str) -> Any:
    """Return a ``type_description_interfaces/msg/TypeDescription`` of a message or a service.

    Raises:
        ConfigurationError: the type is not known.
    """
    definition = service_of(name) if "/srv/" in name else types.definition(name)
    kind = types.message("type_description_interfaces/msg/TypeDescription")
    return kind.new(**description(definition, types.definition))


def _failed(why: str) -> dict[str, Any]:
    return {"successful": False, "failure_reason": why}
