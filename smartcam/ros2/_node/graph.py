"""The graph: the nodes of a domain with their publishers, subscriptions, services and clients."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from smartcam._user_code import ENDS_PROGRAM
from smartcam._zenoh import ZenohDeclared, direct
from smartcam.ros2._node.tokens import (
    CLIENT,
    NODE,
    PUBLISHER,
    SERVICE,
    SUBSCRIPTION,
    Entity,
    token_pattern,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import Any

    from smartcam._zenoh import ZenohSession

logger: logging.Logger = logging.getLogger("smartcam.ros2")

MAX_ENTITIES = 100_000
"""Largest number of nodes and endpoints in the graph; further ones are ignored, with a warning."""


class RosGraph:
    """The known graph of a domain, built from the tokens of nodes and endpoints.

    Args:
        domain: number of the domain.
    """

    def __init__(self, domain: int) -> None:
        self._domain = domain
        self._entities: dict[str, Entity] = {}
        self._by_gid: dict[bytes, Entity] = {}
        self._by_name: dict[tuple[str, str], dict[str, Entity]] = {}
        self._listeners: list[Callable[[Entity, bool], None]] = []
        self._declared: ZenohDeclared | None = None
        self._warned = False

    def open(self, session: ZenohSession) -> None:
        """Subscribe to the tokens."""
        put = session.zenoh.SampleKind.PUT

        def on_sample(sample: Any) -> None:
            session.call_in_loop_uncounted(
                declared.call, self.update, str(sample.key_expr), sample.kind == put
            )

        self._declared = declared = ZenohDeclared(session)
        declared.declare(
            lambda opened: opened.liveliness().declare_subscriber(
                token_pattern(self._domain), direct(on_sample), history=True
            )
        )

    def close(self) -> None:
        """Unsubscribe from the tokens. Idempotent."""
        if self._declared is not None:
            self._declared.close()

    def listen(self, listener: Callable[[Entity, bool], None]) -> Callable[[], None]:
        """Call ``listener(entity, present)`` for each entity that is present, comes or goes.

        Return a function that ends these calls.
        """
        self._listeners.append(listener)
        for entity in tuple(self._entities.values()):
            listener(entity, True)
        return lambda: self._listeners.remove(listener)

    def update(self, token: str, present: bool) -> None:
        """Add or remove the entity of a token."""
        entity = self._entities.get(token)
        if (entity is not None) == present:
            return
        if entity is not None:
            del self._entities[token]
            self._by_gid.pop(entity.gid, None)
            endpoints = self._by_name[entity.name, entity.kind]
            del endpoints[token]
            if not endpoints:
                del self._by_name[entity.name, entity.kind]
            self._notify_watchers(entity, False)
            return
        try:
            entity = Entity.parse(token)
        except ValueError as exc:
            logger.debug("the graph: %s", exc)
            return
        if len(self._entities) >= MAX_ENTITIES:
            if not self._warned:
                self._warned = True
                logger.warning("the graph has more than %d entities", MAX_ENTITIES)
            return
        self._entities[token] = entity
        self._by_gid[entity.gid] = entity
        self._by_name.setdefault((entity.name, entity.kind), {})[token] = entity
        self._notify_watchers(entity, True)

    def _notify_watchers(self, entity: Entity, present: bool) -> None:
        for listener in tuple(self._listeners):
            try:
                listener(entity, present)
            except ENDS_PROGRAM:
                raise
            except BaseException:
                logger.exception("the graph: a listener failed at %s", entity.token)

    # ------------------------------------------------------------------ contents

    def __iter__(self) -> Iterator[Entity]:
        return iter(tuple(self._entities.values()))

    def by_gid(self, gid: bytes) -> Entity | None:
        """Return the entity with a GID; None if there is none."""
        return self._by_gid.get(gid)

    def nodes(self) -> list[str]:
        """Return the full names of all nodes, as ``ros2 node list``."""
        return sorted(entity.full_node for entity in self if entity.kind == NODE)

    def topics(self) -> dict[str, list[str]]:
        """Return the types of each topic by its name, as ``ros2 topic list -t``."""
        return self._types_by_name({PUBLISHER, SUBSCRIPTION})

    def services(self) -> dict[str, list[str]]:
        """Return the types of each service by its name, as ``ros2 service list -t``."""
        return self._types_by_name({SERVICE})

    def endpoints(self, name: str, kind: str) -> list[Entity]:
        """Return the endpoints of a topic or a service.

        Args:
            name: absolute name.
            kind: ``"MP"`` for publishers, ``"MS"`` subscriptions, ``"SS"`` services, ``"SC"``
                clients.
        """
        return list(self._by_name.get((name, kind), {}).values())

    def of_node(self, full_name: str) -> list[Entity]:
        """Return the endpoints of a node, as ``ros2 node info``."""
        return [entity for entity in self if entity.kind != NODE and entity.full_node == full_name]

    def _types_by_name(self, kinds: set[str]) -> dict[str, list[str]]:
        types: dict[str, set[str]] = {}
        for entity in self:
            if entity.kind in kinds:
                types.setdefault(entity.name, set()).add(entity.ros_type)
        return {name: sorted(types[name]) for name in sorted(types)}


OPPOSITE_KIND = {PUBLISHER: SUBSCRIPTION, SUBSCRIPTION: PUBLISHER, SERVICE: CLIENT, CLIENT: SERVICE}
"""The kind of endpoint to which an endpoint of each kind is connected."""
