"""Describe an emulated camera as JSON, for calls and events."""

from __future__ import annotations

import functools
import sys
from typing import TYPE_CHECKING, Any

from smartcam.emulator import LineCamera, TablePose
from smartcam.emulator._inside import TABLE_SIZE, DeviceFault, Observation
from smartcam.emulator.faults import FAULTS
from smartcam.exceptions import InterpretationError
from smartcam.models import jsonable
from smartcam.protocols import BVS
from smartcam.protocols import messages as m
from smartcam.web._shapes import OUTLINES

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from smartcam.emulator import Application, TableScene, WireCamera
    from smartcam.emulator._inside import BaseFault, Device, FiredFault, LogEntry, WireCodec
    from smartcam.models import ByteOrder

SENSOR = (1280, 1024)
"""Width and height, in pixels, of the sensor whose picture the scene is scaled to. The width is
derived from the camera's type code, which contains 1280."""

MAX_HEX_BYTES = 512
"""Largest number of bytes of a payload in a list of log entries; a single entry has all bytes."""

MAX_VALUES_BYTES = 2048
"""Largest number of bytes of a result that a list of log entries shows decoded. A single entry
shows a result of any size decoded."""

MAX_REPLY_BYTES = 1 << 18
"""Largest number of payload bytes that a list of log entries or faults shows. The list ends there,
so that an answer has at most a few megabytes of JSON."""

MAX_LISTED = 1000
"""Largest number of faults that a list shows."""

TABLE_GENERATORS = {"tangram": False, "tangram_pixels": True}
"""Names of the generators that use the table, and whether they report pixels instead of metres."""


# ---------------------------------------------------------------------- the camera


OPERATOR_ACTIONS = (
    "trigger",
    "start",
    "stop",
    "switch_application",
    "set_condition",
    "set_endian",
    "reboot",
)
"""Methods of a device that do what an operator can do at a camera; some devices lack some."""


def abilities(emulator: WireCamera) -> list[str]:
    """Return the names of an operator's actions, with ``scene`` and ``clock`` if present."""
    actions = [name for name in OPERATOR_ACTIONS if hasattr(emulator.device, name)]
    parts = {"scene": emulator.table, "clock": emulator.clock_time}
    return actions + [name for name, part in parts.items() if part is not None]


def camera_row(name: str, emulator: WireCamera) -> dict[str, Any]:
    """Return the row of a camera in a list of cameras."""
    return _row(name, emulator, emulator.shown())


def _row(name: str, emulator: WireCamera, state: dict[str, Any]) -> dict[str, Any]:
    return {
        "name": name,
        "url": emulator.url,
        **{key: state[key] for key in ("mode", "status", "active_application")},
        "session": next(iter(emulator.sessions), None),
    }


def camera_state(name: str, emulator: WireCamera) -> dict[str, Any]:
    """Return the whole state of a camera, except scene, faults and log."""
    state = emulator.shown()
    return {
        **_row(name, emulator, state),
        **state,
        "status_word": state["status"].value,
        "links": emulator.links,
        "commands": list(emulator.commands),
        "host": emulator.host,
        "port": emulator.port,
        "transport": emulator.transport,
        "dialect": emulator.dialect,
        "abilities": abilities(emulator),
        "fault_kinds": sorted(emulator.fault_kinds),
        "faults": {"waiting": len(emulator.faults), "fired": len(emulator.fired)},
    }


def times(emulator: WireCamera) -> dict[str, Any]:
    """Return the time of the log, seconds, and the time of the camera's own clock."""
    with emulator.step():  # advances the device's time
        return {"time": emulator.clock.now, "clock_time": emulator.clock_time}


# ---------------------------------------------------------------------- the log


def log_count(emulator: WireCamera) -> int:
    """Return the number of all entries so far, which is the serial of the next entry."""
    return emulator.log.since(sys.maxsize, 0)[1]


def log_range(emulator: WireCamera) -> dict[str, int]:
    """Return two serials of the log: ``first`` of the oldest entry, ``next`` of the next entry."""
    count = log_count(emulator)
    return {"first": count - len(emulator.log), "next": count}


def log_part(emulator: WireCamera, since: int, limit: int) -> tuple[dict[str, Any], list[LogEntry]]:
    """Return entries from a serial on, as JSON and as objects, up to ``limit`` or MAX_REPLY_BYTES.

    ``next`` is the serial of the entry after these, ``missed`` the number of dropped entries.
    """
    entries, count = emulator.log.since(since, limit)
    first = min(max(since, count - len(emulator.log)), count)
    listed: list[dict[str, Any]] = []
    free_bytes = MAX_REPLY_BYTES
    for serial, entry in enumerate(entries, first):
        listed.append(camera_entry(serial, entry, emulator))
        free_bytes -= min(listed[-1]["size"], MAX_VALUES_BYTES)
        if free_bytes <= 0:
            break
    part = {"entries": listed, "next": first + len(listed), "missed": max(0, first - since)}
    return part, entries[: len(listed)]


def camera_entry(
    serial: int, entry: LogEntry, emulator: WireCamera, *, whole: bool = False
) -> dict[str, Any]:
    """Return an entry of the log; ``serial`` is its number among all entries so far, from 0.

    Unless ``whole``, ``hex`` and ``wire`` end after MAX_HEX_BYTES (``size`` and ``wire_size`` give
    the whole length), and ``values`` is null for more than MAX_VALUES_BYTES.
    """
    hex_length = None if whole else MAX_HEX_BYTES * 3 - 1
    message, wire = entry.message, entry.wire
    values = None if message is None else _values(message, emulator, whole=whole)
    return {
        "serial": serial,
        "time": entry.time,
        "direction": entry.direction,
        "peer": entry.peer,
        "message_id": entry.message_id,
        "message": None if message is None else type(message).__name__,
        "fields": {} if message is None else _fields(message, emulator.codec),
        "values": values,
        "text": entry.text[:MAX_HEX_BYTES] if isinstance(emulator, LineCamera) else None,
        "hex": entry.hex[:hex_length],
        "size": _hex_size(entry.hex),
        "error": entry.error,
        "client_dialect": _client_dialect(entry.hex)
        if entry.error and entry.direction == "in"
        else None,
        "fault": entry.fault,
        "wire": None if wire is None else wire[:hex_length],
        "wire_size": None if wire is None else _hex_size(wire),
    }


def _client_dialect(data: str) -> str | None:
    """Return the dialect that a client tries to speak, by its first bytes; None: no dialect."""
    return next((name for hello, name in _greetings() if data.startswith(hello)), None)


@functools.cache
def _greetings() -> list[tuple[str, str]]:
    return [
        (dialect.encode(hello).hex(" "), dialect.name)
        for dialect in BVS.dialects.values()
        for hello in (m.Disconnect(), m.Connect())
    ]


def _hex_size(text: str) -> int:
    """Return the number of bytes of a hex text."""
    return (len(text) + 1) // 3


def _fields(message: m.Message, dialect: WireCodec) -> dict[str, Any]:
    """Return the fields that a dialect transfers, except data: the payload's hex shows it."""
    names = _field_names(dialect).get(type(message), ())
    return {name: getattr(message, name) for name in names}


@functools.lru_cache(maxsize=16)
def _field_names(dialect: WireCodec) -> Mapping[type[m.Message], tuple[str, ...]]:
    return {
        row.type: tuple(name for name, wire in row.fields if wire is not m.Wire.DATA)
        for row in dialect.table
    }


def _values(message: m.Message, emulator: WireCamera, *, whole: bool) -> Any:
    """Return a result's values by the layout of its application; None without a layout."""
    if not isinstance(message, m.ResultContainer):
        return None
    if message.cells is not None:
        return {cell.cell: cell.text for cell in message.cells}
    application = emulator.application_of(message)
    layout = None if application is None else application.result_layout
    if layout is None or (not whole and len(message.data) > MAX_VALUES_BYTES):
        return None
    try:
        return layout.parse(message.data, _byte_order(emulator.device))
    except InterpretationError:
        return None  # a fault may have changed the bytes


def _byte_order(device: Device) -> ByteOrder:
    return "big" if device.endian == 1 else "little"


# ---------------------------------------------------------------------- faults


def faults_state(emulator: WireCamera, limit: int = MAX_LISTED) -> dict[str, Any]:
    """Return the faults that wait to happen, and the last ones that have happened."""
    waiting, fired = emulator.faults, list(emulator.fired)
    newest_first = (event.fault for event in reversed(fired))
    return {
        "waiting": [_fault(fault) for fault in waiting[: _shown_count(waiting, limit)]],
        "waiting_count": len(waiting),
        "fired": [
            _fired(event) for event in fired[len(fired) - _shown_count(newest_first, limit) :]
        ],
    }


def _shown_count(faults: Iterable[BaseFault], limit: int) -> int:
    """Return the number of faults to show: ``limit`` of them, MAX_REPLY_BYTES of data at most."""
    count, free_bytes = 0, MAX_REPLY_BYTES
    for fault in faults:
        free_bytes -= len(getattr(fault, "data", None) or b"")
        if count == limit or free_bytes < 0:
            break
        count += 1
    return count


def _fault(fault: BaseFault) -> dict[str, Any]:
    fields = fault.model_dump(mode="json", exclude_unset=True)
    return {"kind": getattr(fault, "kind", None), **fields}


def _fired(event: FiredFault) -> dict[str, Any]:
    message = None if event.message is None else type(event.message).__name__
    return {"time": event.time, "fault": _fault(event.fault), "message": message}


def kinds() -> list[dict[str, Any]]:
    """Return every kind of fault with its description and the JSON Schema of its fields."""
    return [
        {
            "kind": kind,
            "of": "device" if issubclass(fault, DeviceFault) else "wire",
            "about": (fault.__doc__ or "").partition("\n")[0].replace("``", "`"),
            "schema": fault.model_json_schema(),
        }
        for kind, fault in FAULTS.items()
    ]


# ---------------------------------------------------------------------- the scene


def scene_state(emulator: WireCamera, scene: TableScene) -> dict[str, Any]:
    """Return the table: true poses of the parts, the camera's view, and the last reported poses.

    Lengths are in metres on the table, angles in radians. ``table_applications`` are
    the ids of the applications that use the table.
    """
    applications = emulator.device.applications.values()
    return {
        "table": {"width": TABLE_SIZE[0], "depth": TABLE_SIZE[1]},
        "sensor": {"width": SENSOR[0], "height": SENSOR[1]},
        "field_of_view": [_corner(scene, u, v) for u, v in _corners()],
        "scale": scene.scale,
        "offset": scene.offset,
        "rotation": scene.rotation,
        "pixel_noise": scene.pixel_noise,
        "seed": scene.seed,
        "y_down": scene.y_down,
        "parts": [_part(scene, name, pose) for name, pose in scene.pieces.items()],
        "table_applications": [row.id for row in applications if _uses_table(row)],
        "reported": _reported(emulator, scene),
    }


def _corners() -> tuple[tuple[float, float], ...]:
    width, height = SENSOR
    return ((0.0, 0.0), (width, 0.0), (width, height), (0.0, height))


def _corner(scene: TableScene, u: float, v: float) -> dict[str, float]:
    pose = scene.to_table(Observation("", u, v, 0.0, 1.0))
    return {"x": pose.x, "y": pose.y}


def _part(scene: TableScene, name: str, pose: TablePose) -> dict[str, Any]:
    u, v, _ = scene.to_pixels(pose)
    return {
        "name": name,
        **pose._asdict(),
        "u": u,
        "v": v,
        "in_view": 0 <= u <= SENSOR[0] and 0 <= v <= SENSOR[1],
        "outline": OUTLINES.get(name),
    }


def _reported(emulator: WireCamera, scene: TableScene) -> dict[str, Any] | None:
    """Return the poses that the last run reported, even if no client received it, or None."""
    last = emulator.last_report
    application = None if last is None else emulator.application_of(last.result)
    layout = None if application is None else application.result_layout
    if last is None or application is None or layout is None or not _uses_table(application):
        return None
    records = layout.parse_records(last.result.data, last.byte_order)
    poses = [
        _pose(record, scene, pixels=TABLE_GENERATORS[str(application.generator)])
        for record in records
    ]
    parts = [pose for pose in poses if pose is not None]
    return {"application": application.id, "time": round(last.time, 6), "parts": parts}


def _uses_table(application: Application) -> bool:
    """Return True if an application uses the table and reports the poses of the parts."""
    layout = application.result_layout
    fields = set[str]() if layout is None else {field.name for field in layout.fields}
    return str(application.generator) in TABLE_GENERATORS and {"x", "y", "theta"} <= fields


def _pose(record: Any, scene: TableScene, *, pixels: bool) -> dict[str, Any] | None:
    values = record._asdict()
    if not any(values.values()):
        return None  # an empty slot of the result
    pose = TablePose(values["x"], values["y"], values["theta"])
    if pixels:
        pose = scene.to_table(Observation("", *pose, 1.0))
    name = values.get("feature_id")
    return {"name": name, **jsonable(pose)}
