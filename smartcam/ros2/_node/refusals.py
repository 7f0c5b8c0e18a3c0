"""Answer a refused call, so that its caller does not wait forever.

rmw_zenoh drops error replies, so its clients would wait forever. A refusal is therefore an ordinary
response, if the type can express it. Many types have fields for a refusal: ``success`` and a text,
or an ``error``. Services of ROS that return lists return an empty list, as rclcpp does if a
parameter is not declared.

A response of any other type, such as a sum, would be a lie. A call of such a type waits until it
can be carried out. If its request is not valid, it gets an error reply, and rmw_zenoh's client
waits forever, as for any node of ROS.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from smartcam.ros2._types.types import MessageType, RosTypes, ServiceType

MAX_REASON_CHARACTERS: Final = 1000
"""Largest number of characters of the reason in an answer; a longer one is cut."""

FLAGS: Final = ("success", "successful")
"""Names of fields that are true if the call was carried out."""

TEXTS: Final = (
    *("error", "error_message", "failure_reason", "message", "reason", "status_message"),
)
"""Names of fields for the reason of a refusal."""

LISTING: Final = ("composition_interfaces", "lifecycle_msgs", "rcl_interfaces")
"""Packages in whose answers an empty list means that nothing is known."""

UNKNOWN_STATE: Final = {"id": 0, "label": "unknown"}
"""The unknown state of a life cycle, in the form of ``lifecycle_msgs/msg/State``."""


def refusal(kind: ServiceType, why: str, types: RosTypes) -> Any:
    """Return the response that refuses a call; None if the type has none.

    Args:
        kind: type of the service.
        why: reason as a text.
        types: types of the nested messages.
    """
    text = why[:MAX_REASON_CHARACTERS].replace("\0", "\ufffd").encode(errors="replace").decode()
    fields = _refused(kind.response, text, types)
    return None if fields is None else kind.response.new(**fields)


def _refused(kind: MessageType, why: str, types: RosTypes) -> dict[str, Any] | None:
    plain = {field.name: field.type for field in kind.fields if not field.shape}
    flags = {name: False for name in FLAGS if plain.get(name) == "bool"}
    texts = {name: why for name in TEXTS if plain.get(name) == "string"}
    if flags or "error" in texts:
        return flags | texts
    if kind.name == "lifecycle_msgs/srv/GetState_Response":
        return {"current_state": UNKNOWN_STATE}
    if len(kind.fields) == 1 and kind.fields[0].nested:
        field = kind.fields[0]
        within = _refused(types.message(field.type), why, types)
        if within:
            return {field.name: [within] if field.shape else within}
        if within is not None and not field.shape:
            return {}
    lists = bool(kind.fields) and all(field.shape == "sequence" for field in kind.fields)
    return {} if lists and kind.name.startswith(LISTING) else None
