"""Serve descriptions of types by their hash: the service ``~/get_type_description``.

As in ``node.c`` of rcl: only the hash is compared, and only types that the node uses are described.
Nodes have the service from Iron on, the first distribution with hashes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam.ros2._types.hash import describe_with_nested, service_definition
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
        if has_description_service(node.types):
            node.parameters.declare(
                PARAMETER,
                True,
                description="Whether ~/get_type_description is served.",
                read_only=True,
            )

    def open(self) -> None:
        """Start the service, if nodes of the distribution have it."""
        if has_description_service(self._node.types):
            self._node.serve("~/get_type_description", TYPE, self._describe)

    async def _describe(self, request: Any) -> dict[str, Any]:
        wanted_hash = request.type_hash
        if not wanted_hash.startswith(PREFIX) or len(wanted_hash) != len(PREFIX) + DIGITS:
            return _failure_fields(
                f"{wanted_hash!r:.100} is no hash: expected RIHS01_ and {DIGITS} digits"
            )
        for entity in self._entities():
            if entity.hash == wanted_hash:
                break
        else:
            return _failure_fields(
                f"{self._node.full_name} uses no type with the hash {wanted_hash}"
            )
        type_description = self._descriptions.get(wanted_hash)
        if type_description is None:
            type_description = self._descriptions[wanted_hash] = describe(
                self._node.types, entity.ros_type
            )
        sources = self._sources(type_description) if request.include_type_sources else []
        return {"successful": True, "type_description": type_description, "type_sources": sources}

    def _sources(self, type_description: Any) -> list[dict[str, str]]:
        """Return the texts of the files of a type and of all nested types."""
        types = (type_description.type_description, *type_description.referenced_type_descriptions)
        return [self._source(message_type.type_name) for message_type in types]

    def _source(self, name: str) -> dict[str, str]:
        encoding, text = self._node.types.source(name)
        return {"type_name": name, "encoding": encoding, "raw_file_contents": text}


def has_description_service(types: RosTypes) -> bool:
    """Return True if nodes of the distribution have the service for descriptions."""
    return types.distribution not in WITHOUT_HASHES


def describe(types: RosTypes, name: str) -> Any:
    """Return a ``type_description_interfaces/msg/TypeDescription`` of a message or a service.

    Raises:
        ConfigurationError: the type is not known.
    """
    definition = service_definition(name) if "/srv/" in name else types.definition(name)
    message_type = types.message("type_description_interfaces/msg/TypeDescription")
    return message_type.new(**describe_with_nested(definition, types.definition))


def _failure_fields(reason: str) -> dict[str, Any]:
    return {"successful": False, "failure_reason": reason}
