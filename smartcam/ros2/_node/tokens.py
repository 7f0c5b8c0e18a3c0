"""Write and read rmw_zenoh's liveliness tokens, and the keys of topics and services.

Source: ``rmw_zenoh_cpp/src/detail/liveliness_utils.cpp``: ``Entity::Entity`` joins the parts, and
computes the GID from them; ``TopicInfo::TopicInfo`` has the key of a topic or a service.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import Final, Literal

from smartcam._forks import cached_property
from smartcam._ros_names import full_name
from smartcam.ros2._node.qos import QoS

ADMIN = "@ros2_lv"

Kind = Literal["NN", "MP", "MS", "SS", "SC"]
NODE: Final = "NN"
PUBLISHER: Final = "MP"
SUBSCRIPTION: Final = "MS"
SERVICE: Final = "SS"
CLIENT: Final = "SC"
KINDS: Final = (NODE, PUBLISHER, SUBSCRIPTION, SERVICE, CLIENT)

_NODE_PARTS, _ENDPOINT_PARTS = {9}, {13, 14}  # the 14th, in newer tokens, names buffer backends


def token_pattern(domain: int) -> str:
    """Return the pattern of all tokens of a domain."""
    return f"{ADMIN}/{domain}/**"


@dataclass(frozen=True)
class Entity:
    """A node, or an endpoint of a topic or a service.

    Attributes:
        kind: one of :data:`KINDS`.
        domain: number of the domain, which separates systems.
        zid: id of the node's Zenoh session.
        node_id, id: numbers within the session.
        namespace: namespace of the node, such as ``/`` or ``/line1``.
        node: name of the node.
        name: absolute name of the topic or service; empty for a node.
        type: type in DDS' form, such as ``std_msgs::msg::dds_::String_``.
        hash: hash of the type.
        qos: requested quality of service.
        enclave: enclave of security, which smartcam does not use.
    """

    kind: Kind
    domain: int
    zid: str
    node_id: int
    id: int
    namespace: str
    node: str
    name: str = ""
    type: str = ""
    hash: str = ""
    qos: QoS = field(default_factory=QoS)
    enclave: str = "/"

    @cached_property
    def token(self) -> str:
        """The entity's liveliness token."""
        parts = [ADMIN, str(self.domain), self.zid, str(self.node_id), str(self.id), self.kind]
        parts += [_mangle(part) for part in (self.enclave, self.namespace, self.node)]
        if self.kind != NODE:
            parts += [_mangle(part) for part in (self.name, self.type, self.hash)]
            parts.append(self.qos.encode())
        return "/".join(parts)

    @cached_property
    def gid(self) -> bytes:
        """The entity's GID in attachments, 16 bytes: a hash of the token."""
        return gid_of(self.token)

    @property
    def key(self) -> str:
        """Key of the topic's messages, or of the service's requests."""
        return f"{self.domain}/{self.name.strip('/')}/{self.type}/{self.hash}"

    @property
    def full_node(self) -> str:
        """The full name of the entity's node."""
        return full_name(self.namespace, self.node)

    @property
    def ros_type(self) -> str:
        """The type in ROS' form, such as ``std_msgs/msg/String``."""
        return self.type.replace("::dds_::", "::").removesuffix("_").replace("::", "/")

    @classmethod
    def parse(cls, token: str) -> Entity:
        """Read a token.

        Raises:
            ValueError: the token is not valid; the text has the expected form.
        """
        parts = token.split("/")
        allowed_counts = _NODE_PARTS if parts[5:6] == [NODE] else _ENDPOINT_PARTS
        if len(parts) not in allowed_counts or parts[0] != ADMIN or parts[5] not in KINDS:
            raise ValueError(
                f"token {token!r:.200}: expected {ADMIN}/DOMAIN/ZID/NODE/ID/KIND/..., KIND one of "
                f"{' '.join(KINDS)}, of 9 parts for a node and 13 else"
            )
        domain, zid, node_id, number = int(parts[1]), parts[2], int(parts[3]), int(parts[4])
        enclave, namespace, node = (_demangle(part) for part in parts[6:9])
        entity = cls(parts[5], domain, zid, node_id, number, namespace, node, enclave=enclave)  # type: ignore[arg-type]
        if entity.kind == NODE:
            return entity
        name, type_name, type_hash = (_demangle(part) for part in parts[9:12])
        return cls(
            entity.kind,
            domain,
            zid,
            node_id,
            number,
            namespace,
            node,
            name,
            type_name,
            type_hash,
            QoS.decode(parts[12]),
            enclave,
        )


def gid_of(token: str) -> bytes:
    """Return the GID of a token: XXH3 with 128 bits, the low half first."""
    import xxhash

    value = xxhash.xxh3_128_intdigest(token.encode())
    return struct.pack("<QQ", value & 0xFFFFFFFFFFFFFFFF, value >> 64)


def _mangle(text: str) -> str:
    return text.replace("/", "%")


def _demangle(text: str) -> str:
    return text.replace("%", "/")
