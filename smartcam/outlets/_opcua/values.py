"""Values of OPC UA: ids, results, and the structures made from layouts."""

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
"""Largest number of fields of a structure made from a layout; further ones are only in the
JSON."""

MAX_RECORDS = 1000
"""Largest number of records of a result that become structures; further ones are only in the
JSON."""

MAX_STRUCTURES = 2000
"""Structures of one server: one for each layout of a camera's application."""

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
"""The types of layouts in OPC UA, and how they are packed; all others are strings."""

_BINARY_IDS = {
    "RecipeIdExternalDataType": 5002,
    "RecipeIdInternalDataType": 5268,
    "ConfigurationIdDataType": 5090,
}
"""Types of ids without fields of their own, and the ids of their encodings: asyncua would send the
abstract type in their place if they had no classes."""


def type_of(kind: str) -> ua.VariantType:
    """Return the type in OPC UA of a layout's type."""
    return TYPES[kind][0] if kind in TYPES else ua.VariantType.String


def plain(value: Any, kind: str) -> Any:
    """Return a value as its type in OPC UA requires it.

    Raises:
        TypeError: the value does not have the type.
    """
    of = type_of(kind)
    if of is ua.VariantType.String and (value is None or isinstance(value, str)):
        return value or ""
    if of is ua.VariantType.Boolean and isinstance(value, bool):
        return value
    if of in (ua.VariantType.Float, ua.VariantType.Double):
        return float("nan") if value is None else float(value)
    if isinstance(value, int) and not isinstance(value, bool) and kind in TYPES:
        return value
    raise TypeError(f"{value!r:.60} is no {kind}")


class Structure(NamedTuple):
    """A structure made from a layout.

    Attributes:
        encoding: node of its binary encoding.
        columns: names, types and units of its fields.
    """

    encoding: ua.NodeId
    columns: tuple[Column, ...]

    def pack_all(self, records: Sequence[Mapping[str, Any]]) -> list[ua.Variant] | None:
        """Return records as structures; None if one has an earlier layout's fields."""
        try:
            packed = [self._pack(record) for record in records]
        except (KeyError, TypeError, ValueError, OverflowError, struct.error):
            return None
        kind = ua.VariantType.ExtensionObject
        return [ua.Variant(ua.ExtensionObject(self.encoding, data), kind) for data in packed]

    def _pack(self, record: Mapping[str, Any]) -> bytes:
        parts: list[bytes] = []
        for name, kind, _ in self.columns:
            value = plain(record[name], kind)
            if isinstance(value, str):
                parts.append(Primitives.String.pack(value))
            else:
                parts.append(struct.pack(TYPES[kind][1], value))
        return b"".join(parts)


class VisionValues:
    """The values of one server.

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
            made = dataclasses.make_dataclass(name, [], bases=(base,))
            of = ua.NodeId(encoding, machine_vision)
            ua.extension_objects_by_typeid[of] = made
            ua.typeid_by_extension_objects[made] = of
            self._classes[name] = made

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
            ProcessingTimes=self._times(result),
            ResultContent=content,
        )

    def _times(self, result: VisionResult) -> Any:
        text = result.fields.get("triggered_at")
        if not isinstance(text, str):
            return None
        start = datetime.fromisoformat(text).astimezone(UTC)
        times = self._classes["ProcessingTimesDataType"]
        return times(StartTime=start, EndTime=result.created)

    async def content(
        self, result: VisionResult, columns: Sequence[Column]
    ) -> list[ua.Variant] | None:
        """Return a result's values: a structure for each record; JSON without a layout."""
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
        """Return the structure of an application's layout, made if it is new."""
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
        """Make the nodes of a structure, with ids that follow from its fields.

        So a client never decodes a new structure by an earlier one.
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
            new_struct_field(field, type_of(kind), description=unit)
            for field, kind, unit in columns
        ]
        await node.write_data_type_definition(definition)
        return Structure(encoding.nodeid, columns)
