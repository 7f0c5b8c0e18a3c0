"""Raise events of the nodeset, with the right type for each field."""

from __future__ import annotations

import copy
import uuid
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from asyncua import ua
from asyncua.common import events

from smartcam.outlets._opcua.nodeset import node_ids

if TYPE_CHECKING:
    from collections.abc import Mapping

SEVERITIES: Mapping[str, int] = {
    "ErrorEventType": 800,
    "VisionPersistentErrorConditionType": 800,
    "VisionDiagnosticInfoEventType": 500,
}
"""Severities of events, 1 to 1000; other events have 100."""

_TYPES: Mapping[str, ua.VariantType] = {
    "BlockReaction": ua.VariantType.Boolean,
    "CausePath": ua.VariantType.String,
    "ConfirmedState/Id": ua.VariantType.Boolean,
    "CreationTime": ua.VariantType.DateTime,
    "ErrorCode": ua.VariantType.UInt64,
    "ErrorString": ua.VariantType.String,
    "ExternalConfigurationId": ua.VariantType.ExtensionObject,
    "ExternalId": ua.VariantType.ExtensionObject,
    "ExternalRecipeId": ua.VariantType.ExtensionObject,
    "InternalConfigurationId": ua.VariantType.ExtensionObject,
    "InternalId": ua.VariantType.ExtensionObject,
    "InternalRecipeId": ua.VariantType.ExtensionObject,
    "IsPartial": ua.VariantType.Boolean,
    "IsSimulated": ua.VariantType.Boolean,
    "ResultContent": ua.VariantType.Variant,
    "ResultState": ua.VariantType.Int32,
    "StopReaction": ua.VariantType.Boolean,
}
"""Types of fields whose data types are abstract or derived; asyncua would send null for them."""

_NODE_IDS = ("FromState/Id", "ToState/Id", "Transition/Id", "NodeId")


class Events:
    """Raises events of cameras, each on the source's node and on the server's node.

    Args:
        server: server of asyncua, with the nodeset.
        machine_vision: index of the nodeset's namespace.
    """

    def __init__(self, server: Any, machine_vision: int) -> None:
        self._server, self._vision = server, machine_vision
        self._templates: dict[str, Any] = {}

    async def emit(
        self, kind: str, source: ua.NodeId, name: str, message: str, fields: Mapping[str, Any]
    ) -> None:
        """Raise an event.

        Args:
            kind: name of the event's type.
            source: node of the camera.
            name: name of the camera.
            message: text of the event.
            fields: other fields of the event; missing fields stay null.

        Raises:
            KeyError: the event's type has no such field.
        """
        template = await self._template(kind)
        event = copy.copy(template)
        now = datetime.now(UTC)
        values = {
            "EventId": uuid.uuid4().bytes,
            "SourceNode": source,
            "SourceName": name,
            "Time": now,
            "ReceiveTime": now,
            "LocalTime": ua.TimeZoneDataType(),
            "Message": ua.LocalizedText(message),
            "Severity": SEVERITIES.get(kind, 100),
            **fields,
        }
        for field, value in values.items():
            if field not in event.data_types:
                raise KeyError(f"{kind} has no field {field}")
            setattr(event, field, value)
        for node in (source, ua.NodeId(ua.ObjectIds.Server)):
            emitted = copy.copy(event)
            emitted.emitting_node = node
            await self._server.iserver.subscription_service.trigger_event(emitted)

    async def _template(self, kind: str) -> Any:
        known = self._templates.get(kind)
        if known is None:
            node = self._server.get_node(ua.NodeId(node_ids()[kind], self._vision))
            known = await events.get_event_obj_from_type_node(node)
            if "EnabledState" in known.data_types:
                known.add_property("NodeId", None, ua.VariantType.NodeId)
            for field, data_type in known.data_types.items():
                known.data_types[field] = _variant_type(field, data_type)
            self._templates[kind] = known
        return known


def _variant_type(field: str, data_type: Any) -> ua.VariantType:
    if field in _NODE_IDS:
        return ua.VariantType.NodeId
    if field in _TYPES:
        return _TYPES[field]
    if isinstance(data_type, ua.NodeId):  # only times have a node id here
        return ua.VariantType.DateTime
    return ua.VariantType(data_type)
