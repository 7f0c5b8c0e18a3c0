"""Answer a refused call, so that its caller does not wait forever.

rmw_zenoh drops error replies, so its clients would wait forever. A refusal is therefore an ordinary
response if the service's type can express it: many types have a field ``success`` with a text, or a
field ``error``. ROS' own services that return lists return an empty list, as rclcpp does if a
parameter is not declared.

A response of any other type would be wrong, such as a number from a service that adds. A call of
such a service waits until it can be carried out. If its request is not valid, the call gets an
error reply, and a client of rmw_zenoh waits forever, as with any node of ROS.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from smartcam.ros2._types.types import MessageType, RosTypes, ServiceType

MAX_REASON_CHARACTERS: Final = 1000
"""Largest number of characters of the reason in an answer; a longer one is cut."""

SUCCESS_FIELDS: Final = ("success", "successful")
"""Names of fields that are true if the call was carried out."""

REASON_FIELDS: Final = (
    *("error", "error_message", "failure_reason", "message", "reason", "status_message"),
)
"""Names of fields for the reason of a refusal."""

LIST_PACKAGES: Final = ("composition_interfaces", "lifecycle_msgs", "rcl_interfaces")
"""Packages in whose answers an empty list means that nothing is known."""

UNKNOWN_STATE: Final = {"id": 0, "label": "unknown"}
"""The unknown state of a life cycle, in the form of ``lifecycle_msgs/msg/State``."""


def refusal_response(service_type: ServiceType, reason: str, types: RosTypes) -> Any:
    """Return the response that refuses a call; None if the type has no such response.

    Args:
        service_type: type of the service.
        reason: reason as a text.
        types: types of the nested messages.
    """
    text = reason[:MAX_REASON_CHARACTERS].replace("\0", "\ufffd").encode(errors="replace").decode()
    fields = _refusal_fields(service_type.response, text, types)
    return None if fields is None else service_type.response.new(**fields)


def _refusal_fields(
    message_type: MessageType, reason: str, types: RosTypes
) -> dict[str, Any] | None:
    types_of_single_fields = {
        field.name: field.type for field in message_type.fields if not field.shape
    }
    flags = {name: False for name in SUCCESS_FIELDS if types_of_single_fields.get(name) == "bool"}
    texts = {name: reason for name in REASON_FIELDS if types_of_single_fields.get(name) == "string"}
    if flags or "error" in texts:
        return flags | texts
    if message_type.name == "lifecycle_msgs/srv/GetState_Response":
        return {"current_state": UNKNOWN_STATE}
    if len(message_type.fields) == 1 and message_type.fields[0].nested:
        field = message_type.fields[0]
        nested_fields = _refusal_fields(types.message(field.type), reason, types)
        if nested_fields:
            return {field.name: [nested_fields] if field.shape else nested_fields}
        if nested_fields is not None and not field.shape:
            return {}
    has_only_lists = bool(message_type.fields) and all(
        field.shape == "sequence" for field in message_type.fields
    )
    return {} if has_only_lists and message_type.name.startswith(LIST_PACKAGES) else None
