"""Make the OPC UA nodes of a camera, and publish the camera's values and events by these nodes."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from asyncua import ua
from asyncua.common.instantiate_util import instantiate

from smartcam.outlets._opcua.book import KeptResult
from smartcam.outlets._opcua.nodeset import AUTOMATIC, VISION, Transition, node_ids, state_ids
from smartcam.outlets._opcua.values import MAX_FIELDS, TYPES, to_opcua_value, variant_type
from smartcam.outlets._records import records_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from smartcam.outlets._opcua.events import Events
    from smartcam.outlets._opcua.jobs import VisionJob, VisionResult
    from smartcam.outlets._opcua.machine import VisionStates
    from smartcam.outlets._opcua.publishing import PublishQueue
    from smartcam.outlets._opcua.values import VisionValues
    from smartcam.outlets._outlet import Column

STATE_MACHINE = "VisionStateMachine"
AUTOMATIC_MACHINE = f"{STATE_MACHINE}.AutomaticModeStateMachine"

_OPTIONAL_PARTS: Sequence[tuple[str, str]] = (
    (AUTOMATIC_MACHINE, AUTOMATIC),
    ("RecipeManagement", "RecipeManagementType"),
    ("ResultManagement", "ResultManagementType"),
    ("ResultManagement.ResultTransfer", "ResultTransferType"),
)
"""Optional parts of a vision system that every camera has, with their types."""

_OPTIONAL_METHODS = (
    (STATE_MACHINE, VISION, ("ConfirmAll", "SelectModeAutomatic")),
    ("ResultManagement", "ResultManagementType", ("ReleaseResultHandle",)),
)

_PLAIN_VARIABLES: Mapping[str, tuple[ua.VariantType, Any]] = {
    "State": (ua.VariantType.String, ""),
    "Error": (ua.VariantType.String, ""),
    "ResultId": (ua.VariantType.String, ""),
    "JobId": (ua.VariantType.String, ""),
    "MeasId": (ua.VariantType.String, ""),
    "PartId": (ua.VariantType.String, ""),
    "Recipe": (ua.VariantType.String, ""),
    "Application": (ua.VariantType.UInt32, 0),
    "ResultState": (ua.VariantType.Int32, 0),
    "CreationTime": (ua.VariantType.DateTime, datetime(1970, 1, 1, tzinfo=UTC)),
    "Records": (ua.VariantType.UInt32, 0),
    "Value": (ua.VariantType.String, ""),
    "Count": (ua.VariantType.UInt32, 0),
}
"""Variables for clients that do not support structures, with their types and initial values. For
each result, ``Count`` is written after all other variables."""


_TEXT = ua.VariantType.String
_PLAIN_METHODS: Mapping[str, tuple[Sequence[tuple[str, ua.VariantType]], ...]] = {
    "StartJob": (
        (("MeasId", _TEXT), ("PartId", _TEXT), ("Recipe", _TEXT)),
        (("JobId", _TEXT),),
    ),
    "PrepareRecipe": ((("Recipe", _TEXT),), (("IsCompleted", ua.VariantType.Boolean),)),
    "GetResult": (
        (("JobId", _TEXT),),
        (("ResultState", ua.VariantType.Int32), ("Value", _TEXT), ("ErrorText", _TEXT)),
    ),
}
"""Methods for clients that do not support structures, with their arguments and their outputs except
for ``Error``."""


class CameraNodes:
    """The nodes of one camera. Methods return at once; changes are published later, in order.

    Args:
        server: server of asyncua, with the nodeset.
        spaces: indexes of the namespaces of the nodeset and of cameras.
        name: name of the camera.
        parts: events, values and the queue that publishes.
    """

    def __init__(
        self,
        server: Any,
        spaces: tuple[int, int],
        name: str,
        parts: tuple[Events, VisionValues, PublishQueue],
    ) -> None:
        self._server, self.name = server, name
        self._vision, self._own_index = spaces
        self._events, self._values, self._publish_queue = parts
        self.root = self.id("")
        self._count = 0
        self._trouble, self._is_confirmed = "", True
        self.prepared: tuple[str, int] = ("", 0)
        self._columns: dict[str, tuple[Column, ...]] = {}

    def id(self, path: str) -> ua.NodeId:
        """Return the id of the node at a path of names below the camera's node."""
        return ua.NodeId(f"{self.name}.{path}" if path else self.name, self._own_index)

    async def make_nodes(self, states: VisionStates) -> None:
        """Make the nodes, and show the states."""
        await self._make_instance(
            self._server.nodes.objects, self.root, "VisionSystemType", self._own_index
        )
        for path, kind in _OPTIONAL_PARTS:
            parent = self._node(path.rpartition(".")[0])
            await self._make_instance(parent, self.id(path), kind, self._vision)
        for path, kind, methods in _OPTIONAL_METHODS:
            for method in methods:
                await self._copy_method(path, kind, method)
        await self._server.get_node(self.root).set_event_notifier(
            [ua.EventNotifier.SubscribeToEvents]
        )
        await self._server.nodes.server.add_reference(self.root, ua.ObjectIds.HasNotifier)
        plain_node = await self._node("").add_object(self.id("Plain"), f"{self._own_index}:Plain")
        for name, (kind, initial) in _PLAIN_VARIABLES.items():
            await plain_node.add_variable(
                self.id(f"Plain.{name}"), f"{self._own_index}:{name}", initial, varianttype=kind
            )
        for name, (inputs, outputs) in _PLAIN_METHODS.items():
            await plain_node.add_method(
                self.id(f"Plain.{name}"),
                ua.QualifiedName(name, self._own_index),
                _not_implemented,
                [_argument(argument_name, kind) for argument_name, kind in inputs],
                [
                    _argument(argument_name, kind)
                    for argument_name, kind in (*outputs, ("Error", ua.VariantType.Int32))
                ],
            )
        await self._show_states(states.vision, states.job_state)

    def _node(self, path: str) -> Any:
        return self._server.get_node(self.id(path))

    async def _make_instance(self, parent: Any, node: ua.NodeId, kind: str, space: int) -> None:
        type_node = self._server.get_node(ua.NodeId(node_ids()[kind], self._vision))
        text = str(node.Identifier)
        name = text if space == self._own_index else text.rpartition(".")[2]
        await instantiate(
            parent,
            type_node,
            nodeid=node,
            bname=ua.QualifiedName(name, space),
            dname=ua.LocalizedText(name),
            instantiate_optional=False,
        )

    async def _copy_method(self, path: str, kind: str, method: str) -> None:
        """Add an optional method to an instance, as a copy of its type's node."""
        type_node = self._server.get_node(ua.NodeId(node_ids()[kind], self._vision))
        pattern = await type_node.get_child(f"{self._vision}:{method}")
        arguments: dict[str, Any] = {"InputArguments": [], "OutputArguments": []}
        for property_ in await pattern.get_properties():
            arguments[(await property_.read_browse_name()).Name] = await property_.read_value()
        inputs, outputs = arguments["InputArguments"], arguments["OutputArguments"]
        name = ua.QualifiedName(method, self._vision)
        await self._node(path).add_method(
            self.id(f"{path}.{method}"), name, _not_implemented, inputs, outputs
        )

    # ------------------------------------------------------------------ changes

    def show_transition(self, transition: Transition, job: VisionJob | None, reason: str) -> None:
        """Show a transition, and raise its events."""
        prepared = self.prepared
        vision = transition.target if transition.machine == VISION else "Operational"
        automatic = transition.target if transition.machine == AUTOMATIC else ""
        if transition.machine == VISION and vision == "Operational":
            automatic = "Initialized"

        async def publish() -> None:
            await self._show_states(vision, automatic)
            fields = self._transition_fields(transition)
            message = f"{transition.name}{': ' * bool(reason)}{reason}"
            kinds = [*transition.effects]
            if transition.target == "Error" and "ErrorEventType" not in kinds:
                kinds.append("ErrorEventType")  # according to the text of OPC 40100-1
            for kind in kinds:
                is_state_event = kind in _STATE_EVENTS
                event_fields = fields if is_state_event else self._job_fields(kind, job, prepared)
                await self._emit(kind, message, event_fields)

        self._publish_queue.put(publish)

    def show_acquisition(self, job: VisionJob) -> None:
        """Raise the event that reports that a job's picture is taken."""
        kind = "AcquisitionDoneEventType"
        fields = self._job_fields(kind, job, self.prepared)
        self._publish_queue.put(lambda: self._emit(kind, f"job {job.id} has its picture", fields))

    def show_result(
        self,
        result: VisionResult,
        recipe: str,
        columns: Sequence[Column],
        keep: Callable[[KeptResult], None],
    ) -> None:
        """Show a result, and raise its event.

        Args:
            result: the result.
            recipe: name of the result's recipe.
            columns: names, types and units of the result's values.
            keep: function that keeps the result for requests of clients; called before the event.
        """

        async def publish() -> None:
            content = await self._values.content(result, columns)
            value = self._values.result(result, recipe, content)
            json_value = result.fields.get("value")
            text = "" if json_value is None else json.dumps(json_value, separators=(",", ":"))
            keep(KeptResult(result, value, recipe, text))
            await self._show_plain(result, recipe, columns, text)
            names = value.__dataclass_fields__
            fields = {
                name: getattr(value, name)
                for name in names
                if name not in ("Encoding", "HasTransferableDataOnFile")
            }
            await self._emit("ResultReadyEventType", result.error or result.id, fields)

        self._publish_queue.put(publish)

    def show_message(self, text: str, kind: str, job: VisionJob | None) -> None:
        """Raise an event with a text."""
        fields: dict[str, Any] = {"CausePath": kind}
        if job is not None:
            fields |= {"JobId": self._values.identity("JobIdDataType", job.id)}
            fields |= {"MeasId": job.meas, "PartId": job.part, "ProductId": job.product}

        async def publish() -> None:
            await self._write("Plain.Error", ua.Variant(text, ua.VariantType.String))
            await self._emit("VisionDiagnosticInfoEventType", text, fields)

        self._publish_queue.put(publish)

    def show_trouble(self, reason: str) -> None:
        """Show the reason why the camera cannot be used, as a condition; "" if it can be used."""
        self._trouble, self._is_confirmed = reason, not reason
        self._publish_queue.put(lambda: self._publish_trouble(reason, confirmed=not reason))

    def confirm_trouble(self) -> None:
        """Show that a client has confirmed the condition, if there is one."""
        if not self._is_confirmed:
            self._is_confirmed, reason = True, self._trouble
            self._publish_queue.put(lambda: self._publish_trouble(reason, confirmed=True))

    async def _publish_trouble(self, reason: str, *, confirmed: bool) -> None:
        await self._write("Plain.Error", ua.Variant(reason, ua.VariantType.String))
        fields = _condition(self.id("Condition"), bool(reason), confirmed) | {"ErrorString": reason}
        text = reason or "the camera is there"
        await self._emit("VisionPersistentErrorConditionType", text, fields)

    # ------------------------------------------------------------------ values and events

    async def _emit(self, kind: str, message: str, fields: Mapping[str, Any]) -> None:
        await self._events.emit(kind, self.root, self.name, message, fields)

    async def _write(self, path: str, value: ua.Variant, status: int = 0) -> None:
        data_value = ua.DataValue(value, StatusCode=ua.StatusCode(status), SourceTimestamp=_now())
        node = self.id(path)
        (
            await self._server.iserver.aspace.write_attribute_value(
                node, ua.AttributeIds.Value, data_value
            )
        ).check()

    async def _show_states(self, vision: str, automatic: str) -> None:
        for path, machine, state in (
            (STATE_MACHINE, VISION, vision),
            (AUTOMATIC_MACHINE, AUTOMATIC, automatic),
        ):
            status = 0 if state else ua.StatusCodes.BadStateNotActive
            text = ua.Variant(ua.LocalizedText(state), ua.VariantType.LocalizedText)
            node = ua.Variant(self._state(machine, state), ua.VariantType.NodeId)
            await self._write(f"{path}.CurrentState", text, status)
            await self._write(f"{path}.CurrentState.Id", node, status)
        await self._write("Plain.State", ua.Variant(automatic or vision, ua.VariantType.String))

    def _state(self, machine: str, state: str) -> ua.NodeId:
        """Return the node of a state, which belongs to the type of the state machine."""
        return ua.NodeId(state_ids()[machine, state], self._vision) if state else ua.NodeId()

    def _transition_fields(self, transition: Transition) -> dict[str, Any]:
        machine = transition.machine
        return {
            "FromState": ua.LocalizedText(transition.source),
            "FromState/Id": self._state(machine, transition.source),
            "ToState": ua.LocalizedText(transition.target),
            "ToState/Id": self._state(machine, transition.target),
            "Transition": ua.LocalizedText(transition.name),
            "Transition/Id": ua.NodeId(transition.node, self._vision),
        }

    def _job_fields(
        self, kind: str, job: VisionJob | None, prepared: tuple[str, int]
    ) -> dict[str, Any]:
        """Return the fields of an event about a job or a recipe."""
        identity = self._values.identity
        if kind != "RecipePreparedEventType":
            return {"JobId": identity("JobIdDataType", "" if job is None else job.id)}
        recipe, application = prepared
        return {
            "ExternalId": identity("RecipeIdExternalDataType", recipe),
            "InternalId": identity("RecipeIdInternalDataType", str(application)),
        }

    async def _show_plain(
        self, result: VisionResult, recipe: str, columns: Sequence[Column], text: str
    ) -> None:
        """Write the plain variables; the counter is written last."""
        self._count = (self._count + 1) % (1 << 32)
        records = records_of(result.fields.get("value")) or []
        job = result.job
        values = {
            "Error": result.error,
            "ResultId": result.id,
            "JobId": result.job_id,
            "MeasId": "" if job is None or job.meas is None else job.meas.Id,
            "PartId": "" if job is None or job.part is None else job.part.Id,
            "Recipe": recipe,
            "Application": result.application or 0,
            "ResultState": result.state,
            "CreationTime": result.created,
            "Records": len(records),
            "Value": text,
        }
        for name, value in values.items():
            await self._write(f"Plain.{name}", ua.Variant(value, _PLAIN_VARIABLES[name][0]))
        if columns and result.application is not None:
            first = records[0] if records and not result.error else {}
            await self._show_columns(f"App{result.application}", columns[:MAX_FIELDS], first)
        await self._write("Plain.Count", ua.Variant(self._count, ua.VariantType.UInt32))

    async def _show_columns(
        self, folder: str, columns: Sequence[Column], record: Mapping[str, Any]
    ) -> None:
        """Write the values of the first record; missing values get a bad status."""
        if self._columns.get(folder) != tuple(columns):
            await self._make_columns(folder, columns)
        for name, kind, _ in columns:
            path = f"Plain.{folder}.{name}"
            try:
                value = ua.Variant(to_opcua_value(record[name], kind), variant_type(kind))
            except (KeyError, TypeError, ValueError):
                await self._write(path, ua.Variant(), ua.StatusCodes.BadNoData)
            else:
                await self._write(path, value)

    async def _make_columns(self, folder: str, columns: Sequence[Column]) -> None:
        """Make a variable for each value; they replace the variables of an earlier layout."""
        node = self._node(f"Plain.{folder}")
        if folder in self._columns:
            await self._server.delete_nodes([node], recursive=True)
        parent = self._node("Plain")
        node = await parent.add_object(self.id(f"Plain.{folder}"), f"{self._own_index}:{folder}")
        for name, kind, unit in columns:
            variable = await node.add_variable(
                self.id(f"Plain.{folder}.{name}"),
                ua.QualifiedName(name, self._own_index),
                to_opcua_value(_ZEROS.get(kind, 0 if kind in TYPES else ""), kind),
                varianttype=variant_type(kind),
                datatype=ua.NodeId(variant_type(kind).value),
            )
            if unit:
                await variable.write_attribute(
                    ua.AttributeIds.Description, ua.DataValue(ua.LocalizedText(unit))
                )
        self._columns[folder] = tuple(columns)


_ZEROS: Mapping[str, Any] = {"bool": False, "real32": 0.0, "real64": 0.0}
_STATE_EVENTS = ("StateChangedEventType", "ErrorEventType", "ErrorResolvedEventType")


def _condition(node: ua.NodeId, active: bool, confirmed: bool) -> dict[str, Any]:
    return {
        "NodeId": node,
        "ConditionName": "Camera",
        "Retain": active,
        "EnabledState": ua.LocalizedText("Enabled"),
        "EnabledState/Id": True,
        "AckedState": ua.LocalizedText("Acknowledged" if confirmed else "Unacknowledged"),
        "AckedState/Id": confirmed,
        "ConfirmedState": ua.LocalizedText("Confirmed" if confirmed else "Unconfirmed"),
        "ConfirmedState/Id": confirmed,
        "Quality": ua.StatusCode(),
        "LastSeverity": 800,
        "Comment": ua.LocalizedText(""),
        "BlockReaction": active,
        "StopReaction": active,
        "CausePath": "Camera",
    }


def _argument(name: str, kind: ua.VariantType) -> ua.Argument:
    return ua.Argument(Name=name, DataType=ua.NodeId(kind.value), ValueRank=-1)


async def _not_implemented(_parent: ua.NodeId, *_arguments: ua.Variant) -> ua.StatusCode:
    return ua.StatusCode(ua.StatusCodes.BadNotImplemented)


def _now() -> datetime:
    return datetime.now(UTC)
