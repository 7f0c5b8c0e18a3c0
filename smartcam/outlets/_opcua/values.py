"""Convert ids, results and records to OPC UA's values and structures."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import struct
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

from asyncua import ua
from asyncua.common.manage_nodes import create_data_type, create_encoding
from asyncua.common.structures104 import new_struct_field
from asyncua.ua.ua_binary import Primitives

from smartcam.outlets._opcua.nodeset import node_ids
from smartcam.outlets._records import records_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from smartcam.outlets._opcua.jobs import VisionResult
    from smartcam.outlets._outlet import Column

MAX_FIELDS = 500
"""Largest number of fields of a layout's structure; further fields are only in the JSON."""

MAX_RECORDS = 1000
"""Largest number of records of a result that become structures; further ones are only in JSON."""

MAX_STRUCTURES = 2000
"""Largest number of structures of one server, which has one for each layout of an application."""

TYPES: Mapping[str, tuple[ua.VariantType, str]] = {
    "bool": (ua.VariantType.Boolean, "<?"),
    "int8": (ua.VariantType.SByte, "<b"),
    "uint8": (ua.VariantType.Byte, "<B"),
    "int16": (ua.VariantType.Int16, "<h"),
    "uint16": (ua.VariantType.UInt16, "<H"),
    "int32": (ua.VariantType.Int32, "<i"),
    "uint32": (ua.VariantType.UInt32, "<I"),
    "int64": (ua.VariantType.Int64, "<q"),
    "uint64": (ua.VariantType.UInt64, "<Q"),
    "real32": (ua.VariantType.Float, "<f"),
    "real64": (ua.VariantType.Double, "<d"),
}
"""OPC UA's type, and the format of ``struct``, for each type of layouts; other types are
strings."""

_BINARY_IDS = {
    "RecipeIdExternalDataType": 5002,
    "RecipeIdInternalDataType": 5268,
    "ConfigurationIdDataType": 5090,
}
"""Types of ids that add no fields to their base type, and the node ids of their binary encodings.
Each type needs a Python class, since asyncua would otherwise send the abstract base type."""


def variant_type(kind: str) -> ua.VariantType:
    """Return OPC UA's type for a layout's type."""
    return TYPES[kind][0] if kind in TYPES else ua.VariantType.String


def to_opcua_value(value: Any, kind: str) -> Any:
    """Return a value for OPC UA; None becomes "" or NaN.

    Raises:
        TypeError: the value does not have the type.
    """
    value_type = variant_type(kind)
    if value_type is ua.VariantType.String and (value is None or isinstance(value, str)):
        return value or ""
    if value_type is ua.VariantType.Boolean and isinstance(value, bool):
        return value
    if value_type in (ua.VariantType.Float, ua.VariantType.Double):
        return float("nan") if value is None else float(value)
    if isinstance(value, int) and not isinstance(value, bool) and kind in TYPES:
        return value
    raise TypeError(f"{value!r:.60} is no {kind}")


class Structure(NamedTuple):
    """A structure type that was made for a layout.

    Attributes:
        encoding: node of the binary encoding.
        columns: names, types and units of the fields.
    """

    encoding: ua.NodeId
    columns: tuple[Column, ...]

    def pack_all(self, records: Sequence[Mapping[str, Any]]) -> list[ua.Variant] | None:
        """Return records as structures; None if a record does not have the fields of the layout."""
        try:
            packed = [self._pack(record) for record in records]
        except (KeyError, TypeError, ValueError, OverflowError, struct.error):
            return None
        kind = ua.VariantType.ExtensionObject
        return [ua.Variant(ua.ExtensionObject(self.encoding, data), kind) for data in packed]

    def _pack(self, record: Mapping[str, Any]) -> bytes:
        parts: list[bytes] = []
        for name, kind, _ in self.columns:
            value = to_opcua_value(record[name], kind)
            if isinstance(value, str):
                parts.append(Primitives.String.pack(value))
            else:
                parts.append(struct.pack(TYPES[kind][1], value))
        return b"".join(parts)


class VisionValues:
    """Makes the values of one server.

    Args:
        server: server of asyncua, with the nodeset.
        machine_vision: index of the nodeset's namespace.
        own_index: index of the namespace of cameras.
    """

    def __init__(self, server: Any, machine_vision: int, own_index: int) -> None:
        self._server, self._vision, self._own_index = server, machine_vision, own_index
        self._structures: dict[tuple[str, int, tuple[Column, ...]], Structure] = {}
        base: Any = getattr(ua, "BinaryIdBaseDataType")  # noqa: B009 - made from the nodeset
        self._classes: dict[str, Any] = {
            name: getattr(ua, name) for name in node_ids() if hasattr(ua, name)
        }
        for name, encoding in _BINARY_IDS.items():
            class_ = dataclasses.make_dataclass(name, [], bases=(base,))
            type_id = ua.NodeId(encoding, machine_vision)
            ua.extension_objects_by_typeid[type_id] = class_
            ua.typeid_by_extension_objects[class_] = type_id
            self._classes[name] = class_

    def identity(self, kind: str, text: str) -> Any:
        """Return an id of a type such as ``JobIdDataType``."""
        return self._classes[kind](Id=text)

    def result(self, result: VisionResult, recipe: str, content: list[ua.Variant] | None) -> Any:
        """Return a result as the nodeset's structure.

        Args:
            result: the result.
            recipe: name of its recipe.
            content: values of the result; None without values.
        """
        job = result.job
        application = "" if result.application is None else str(result.application)
        return self._classes["ResultDataType"](
            ResultId=self.identity("ResultIdDataType", result.id),
            HasTransferableDataOnFile=result.picture is not None,
            IsPartial=False,
            IsSimulated=result.simulated,
            ResultState=result.state,
            MeasId=None if job is None else job.meas,
            PartId=None if job is None else job.part,
            ExternalRecipeId=self.identity("RecipeIdExternalDataType", recipe),
            InternalRecipeId=self.identity("RecipeIdInternalDataType", application),
            ProductId=None if job is None else job.product,
            ExternalConfigurationId=None,
            InternalConfigurationId=self.identity("ConfigurationIdDataType", ""),
            JobId=self.identity("JobIdDataType", result.job_id),
            CreationTime=result.created,
            ProcessingTimes=self._processing_times(result),
            ResultContent=content,
        )

    def _processing_times(self, result: VisionResult) -> Any:
        text = result.fields.get("triggered_at")
        if not isinstance(text, str):
            return None
        start = datetime.fromisoformat(text).astimezone(UTC)
        times = self._classes["ProcessingTimesDataType"]
        return times(StartTime=start, EndTime=result.created)

    async def content(
        self, result: VisionResult, columns: Sequence[Column]
    ) -> list[ua.Variant] | None:
        """Return a result's values: a structure for each record, otherwise JSON."""
        value = result.fields.get("value")
        if value is None:
            return None
        records = records_of(value)
        structure = await self._structure(result, columns) if records is not None else None
        if structure is not None and records is not None:
            packed = structure.pack_all(records[:MAX_RECORDS])
            if packed is not None:
                return packed
        text = json.dumps(value, separators=(",", ":"))
        return [ua.Variant(text, ua.VariantType.String)]

    async def _structure(self, result: VisionResult, columns: Sequence[Column]) -> Structure | None:
        """Return the structure of an application's layout; make it if it is new."""
        if not columns or result.application is None:
            return None
        key = result.camera, result.application, tuple(columns[:MAX_FIELDS])
        known = self._structures.get(key)
        if known is None and len(self._structures) < MAX_STRUCTURES:
            known = self._structures[key] = await self._make_structure(*key)
        return known

    async def _make_structure(
        self, camera: str, application: int, columns: tuple[Column, ...]
    ) -> Structure:
        """Make the nodes of a structure; their ids depend on its fields.

        So a client that has read an earlier layout's structure never decodes new values with it.
        """
        versions = sum(known[:2] == (camera, application) for known in self._structures)
        name = f"{camera}.App{application}" + f"v{versions + 1}" * bool(versions)
        digest = hashlib.sha256(repr(columns).encode()).hexdigest()[:16]
        key = f"types.{camera}.App{application}.{digest}"
        node = await create_data_type(
            self._server.nodes.base_structure_type,
            ua.NodeId(key, self._own_index),
            ua.QualifiedName(name, self._own_index),
        )
        encoding = await create_encoding(
            node, ua.NodeId(f"{key}.Binary", self._own_index), ua.QualifiedName("Default Binary", 0)
        )
        definition = ua.StructureDefinition()
        definition.BaseDataType = self._server.nodes.base_structure_type.nodeid
        definition.StructureType = ua.StructureType.Structure
        definition.DefaultEncodingId = encoding.nodeid
        definition.Fields = [
            new_struct_field(field, variant_type(kind), description=unit)
            for field, kind, unit in columns
        ]
        await node.write_data_type_definition(definition)
        return Structure(encoding.nodeid, columns)
