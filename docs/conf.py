"""Sphinx configuration, and the tables that are made from the code when the documents are built.

A page asks for one with::

    ```{generated} messages
    ```

The functions in :data:`GENERATED` need nothing of Sphinx; ``tests/test_docs.py`` calls them too.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import importlib
import inspect
import itertools
import json
import re
import struct
import textwrap
import tomllib
import typing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

import smartcam
from smartcam._client.handshake import load_protocol
from smartcam._settings_model import OPTIONS
from smartcam.calibration._files.storage import Stored
from smartcam.emulator import Application, InSightQuirks, Quirks, Scenario, faults
from smartcam.emulator._scenario.timeline import Cue
from smartcam.emulator.faults._base import DeviceFault, WireFault
from smartcam.fleet._file.fleet_file import (
    CameraEntry,
    Emulated,
    FleetFile,
    FramesEntry,
    History,
    Retry,
)
from smartcam.fleet._file.operations import OperationsSection
from smartcam.fleet._file.recording import RecordSection
from smartcam.fleet._file.ros import RosCamera, RosSection
from smartcam.fleet._file.standby import Standby
from smartcam.fleet._security.access import RIGHTS
from smartcam.fleet._security.certificates import ROLES
from smartcam.protocols._base import POLICIES
from smartcam.protocols._bvs import B16, BID, BVS, CODES, HANDBOOK, THESIS
from smartcam.protocols._framed.dialect import MAX_SURPLUS_BYTES
from smartcam.protocols._framed.machine import TRANSITIONS
from smartcam.protocols._machine import State
from smartcam.protocols.messages import Request, Sender, Wire
from smartcam.registry import PROTOCOLS
from smartcam.settings import CameraSettings, parse_address
from smartcam.web import _clouds as cloud_page
from smartcam.web import _colours as colour_page
from smartcam.web import _emulator as emulator_page
from smartcam.web import _fleet as fleet_page
from smartcam.web import _frames as frames_page
from smartcam.web import _live as live_page
from smartcam.web import _wizard as wizard_page

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from pydantic.fields import FieldInfo

    from smartcam.protocols._framed.dialect import FramedDialect, MessageRow

project = "smartcam"
version = release = smartcam.__version__
copyright = "the smartcam maintainers"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
html_extra_path = ["fleet.schema.json", "scenario.schema.json"]
html_theme = "furo"
html_title = f"smartcam {release}"
myst_heading_anchors = 4
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "show-inheritance": True}
napoleon_use_ivar = True
napoleon_custom_sections = ["Cancellation", "Source"]

ROOT = Path(__file__).parents[1]

USES = {
    "put": "puts",
    "subscribe": "subscribes",
    "query": "queries",
    "answer": "answers queries",
    "announce": "has tokens",
    "watch": "looks for tokens",
}
"""Kinds of use in Zenoh's words."""

WORDS = {"I": "UINT32", "H": "UINT16"}
"""A dialect's ordinary integers."""

LIMITS = (
    "protocols._framed.framing.DEFAULT_MAX_LENGTH",
    "protocols._framed.framing.MIN_OWN_BUFFER_BYTES",
    "protocols._framed.framing.FIRST_READ_BYTES",
    "protocols._framed.framing.MAX_READ_BYTES",
    "protocols._framed.framing.MIN_READ_BYTES",
    "protocols._framed.machine.MAX_EVENTS_PER_READ",
    "protocols._framed.machine.MAX_FRAMES_PER_READ",
    "protocols._framed.dialect.MAX_SURPLUS_BYTES",
    "protocols._framed.dialect.MAX_CACHED_MESSAGES",
    "protocols._framed.frame_age.FRAME_TIME",
    "protocols._framed.frame_age.MIN_BYTES_PER_SECOND",
    "protocols._framed.frame_age.HINT_TIME",
    "_client.link.MAX_CHUNKS",
    "_client.link.MAX_DATAGRAMS",
    "_client.link.MIN_FRAMES_PER_CHUNK",
    "_client.link.FIRST_CHUNK_FRAMES",
    "_client.link.MAX_CHUNK_FRAMES",
    "_client.link.TURN_TIME",
    "_zenoh.CALLBACKS_PER_TURN",
    "_zenoh.LATER_CALLBACKS_PER_TURN",
    "_client.link.MAX_REST_BYTES",
    "camera.DEFAULT_MAX_QUEUE",
    "camera.DEFAULT_MAX_QUEUE_BYTES",
    "camera.MAX_INTERPRETATIONS",
    "camera.DEFAULT_TRIGGER_TIMEOUT",
    "_client.handshake.MAX_EARLY_BYTES",
    "_client.handshake.DETECTION_TIMEOUT",
    "_client.handshake.MIN_STATUS_ANSWERS",
    "_client.handshake.BUSY_PAUSE",
    "_client.status.BUSY_PAUSE",
    "_client.polling.PERIOD",
    "_client.polling.IDLE_PERIOD",
    "_client.polling.REPEAT_AFTER",
    "_client.triggering.LATE_GRACE",
    "_client.triggering.OVERTRIGGERED_GRACE",
    "_client.correlation.NUMBER_STEP",
    "_client.correlation.MAX_OWED",
    "_client.dispatch.MAX_NOTICE_CHARACTERS",
    "_client.limited_log.MAX_LINES",
    "_client.limited_log.PERIOD",
    "_client.supervisor.TAKEN_WITHIN",
    "exceptions.MAX_EXCERPT_BYTES",
    "_accepting.ACCEPT_PAUSE",
    "_accepting.BACKLOG",
    "_accepting.HANDSHAKE_TIMEOUT",
    "_accepting.RESERVED_DESCRIPTORS",
    "_accepting.DESCRIPTORS_LEFT_BY_EMULATORS",
    "emulator._client_link.MAX_INPUT_BYTES",
    "emulator._wire_camera.MAX_LINKS",
    "emulator._wire_camera.WRITE_LIMIT",
    "emulator._application.MAX_CONTAINER_BYTES",
    "emulator._links.CLOSE_TIMEOUT",
    "emulator._traffic.MAX_ENTRIES",
    "emulator._traffic.MAX_BYTES",
    "emulator._traffic.MAX_IDS",
    "emulator.faults.MAX_FAULTS",
    "emulator.faults.MAX_FIRED",
    "emulator.faults._base.MAX_BYTES",
    "protocols._insight.words.MAX_LINE_BYTES",
    "protocols._insight.words.MAX_CELLS",
    "protocols._insight.answers.MAX_IMAGE_BYTES",
    "emulator._insight.connection.MAX_SESSIONS",
    "emulator._line_camera.MAX_INPUT_BYTES",
    "emulator._insight.connection.WRITE_LIMIT",
    "emulator._line_camera.MAX_SCHEDULED_CALLS",
    "emulator._insight.camera.MAX_NEXT_CODES",
    "emulator._insight.image.MAX_PIXELS",
    "emulator._insight.job.MAX_CELL_TEXT_CHARACTERS",
    "protocols._insight.machine.MAX_READ_BYTES",
    "protocols._lines.MAX_READ_BYTES",
    "protocols._held_results.MAX_HELD",
    "protocols._held_results.MAX_HELD_BYTES",
    "emulator._ticketed_camera.MAX_REQUEST_BYTES",
    "makes._ifm.dialect.MAX_INPUT_BYTES",
    "makes._ifm.layouts.MAX_DEPTH",
    "makes._keyence.words.MAX_LINE_BYTES",
    "emulator._line_codec.MAX_LOGGED_BYTES",
    "protocols._insight.dialect.MAX_LOGIN_CHARACTERS",
    "emulator._scenario.timeline.MAX_PENDING",
    "emulator._scenario.timeline.MAX_CUES_AT_ONCE",
    "emulator._scenario.timeline.MAX_FAULTS_OF_CUE",
    "emulator._scenario.scenario.MAX_CUES",
    "emulator._traffic.MAX_ENDED_CONNECTIONS",
    "layout._yaml_parsing.MAX_BITS",
    "layout._yaml_parsing.MAX_DEPTH",
    "layout._yaml_parsing.MAX_NODES",
    "layout._yaml_parsing.MAX_YAML_TEXT_CHARACTERS",
    "_suggestions.MAX_WORD_CHARACTERS",
    "_suggestions.MAX_KNOWN_WORDS",
    "depth._tables.MAX_LINE_BYTES",
    "depth._tables.NUMBERS_AT_A_TIME",
    "depth._pcd.MAX_UNPACKED_BYTES",
    "frames._gige.assembler.MAX_GAPS_PER_BLOCK",
    "frames._gige.description.MAX_PLAIN_BYTES",
    "frames._gige.description.MAX_PACKED_BYTES",
    "frames._gige.description.MAX_ELEMENTS",
    "frames._gige.features.MAX_ELEMENTS_VISITED",
    "fleet._security.certificates.MAX_BYTES",
    "fleet._agent.agent.MAX_CALLS_PER_PROGRAM",
    "fleet._agent.agent.MAX_REMEMBERED_CALLS",
    "fleet._agent.agent.FIRST_ATTEMPT_TIMEOUT",
    "fleet._agent.calls.MAX_REPLY_BYTES",
    "fleet._program.caller.HELLO_TIMEOUT",
    "fleet._program.camera.CATCH_UP_TIMEOUT",
    "fleet._bus.errors.MAX_CHAIN",
    "fleet._file.fleet_file.MAX_CAMERAS_PER_AGENT",
    "fleet._program.program.AGENT_SEARCH_INTERVAL",
    "fleet._program.receiver.MISSING_TIMEOUT",
    "_zenoh.LEASE_TIME",
    "fleet._bus.zenoh.MAX_DIRECT_BYTES",
    "_zenoh.MAX_WAITING_BYTES",
    "_zenoh.CALLBACKS_PER_TURN",
    "recording._mcap.form.MAX_CAMERAS",
    "recording._mcap.form.MAX_MESSAGE_BYTES",
    "recording._mcap.form.MAX_NAME_CHARACTERS",
    "recording._mcap.form.MAX_VALUES",
    "recording._replays.schedule.MAX_REPLAY_BYTES",
    "recording._reader.VALUE_ALLOWANCE",
    "recording._reader.VALUES_PER_BYTE",
    "recording._mcap.records.MAX_CHUNK_BYTES",
    "recording._mcap.records.MAX_METADATA_BYTES",
    "recording._mcap.records.MAX_RECORD_BYTES",
    "recording._mcap.records.RECORD_ALLOWANCE",
    "recording._mcap.records.UNPACKED_BYTES_ALLOWANCE",
    "recording._mcap.records.UNPACKED_PER_BYTE",
    "_loop_thread.CALL_TIMEOUT",
    "calibration._plane.fitting.MAX_STEPS",
    "calibration._files.directory.MAX_NAME_LENGTH",
    "_whole_files.LOCK_TIMEOUT",
    "calibration.formats._file_format.MAX_FILE_BYTES",
    "calibration.formats._file_format.MAX_TEXT_BYTES",
    "calibration.formats._file_format.MAX_YAML_BYTES",
    "calibration.formats._plain.MAX_DEPTH",
    "calibration.formats._plain.MAX_NUMBER",
    "calibration.formats._plain.MAX_SIDE",
    "calibration.formats._trajectories.MAX_LINE_LENGTH",
    "calibration._least_squares.MAX_STEPS",
    "calibration.formats._foreign.MAX_CAMERAS",
    "calibration.formats._cameras.MAX_CAMERA_FILE_BYTES",
    "calibration._detection.charucos.MAX_DOUBLED_PX",
    "calibration._detection.circle_grids.EXTRA_SPOTS",
    "calibration._detection.corners.MAX_REACH_PX",
    "calibration._detection.dots.MAX_REACH_PX",
    "calibration._detection.image.MAX_SIDE_PX",
    "calibration._detection.image.MIN_SIDE_PX",
    "calibration._detection.image.USUAL_SIDE_PX",
    "calibration._hand_eye.model_selection.MAX_FOLDS",
    "calibration._detection.grid_growing.MAX_SEEDS_TRIED",
    "calibration.wizards._hand_eye.MAX_VIEWS",
    "calibration._detection.levenberg.MAX_STEPS",
    "calibration.wizards._pictures.FOLDER_TIMEOUT",
    "calibration.wizards._pictures.MAX_FILES",
    "calibration.wizards._pictures.MAX_PICTURE_BYTES",
    "calibration._detection.ordering.MIN_ORIGIN_CONTRAST",
    "calibration.wizards._target_drawing.MAX_SIDE_PX",
    "calibration._stereo.rectification.MAX_PIXELS",
    "calibration._printing.sheets.MAX_PAGE_MM",
    "calibration._targets.MAX_POINTS",
    "calibration.wizards._pictures.MAX_PREVIEW_BYTES",
    "calibration.wizards._pictures.PICTURE_TIMEOUT",
    "calibration.wizards._journal.MAX_ENTRIES",
    "calibration.wizards._journal.MAX_LINE_BYTES",
    "calibration.wizards._services.MAX_EARLIER_JOURNALS",
    "calibration._files.store.BACKUPS",
    "calibration._files.store.MAX_FILE_BYTES",
    "calibration.wizards._verification.MAX_TOUCHES",
    "calibration.wizards._marks.MAX_MARKS",
    "calibration.wizards._touch_previews.HEAT_MAP_CELLS",
    "calibration._plane.robust.MAX_ITERATIONS",
    "calibration._plane.robust.MAX_SUBSETS_TRIED",
    "calibration.wizards._points.MAX_POINTS",
    "recording._recorder.INTERVAL",
    "recording._recorder.CHUNK",
    "recording._recorder.MAX_WAITING_BYTES",
    "recording._recorder.CLOSE_TIMEOUT",
    "conformance.client._tasks.MAX_OUTPUT_BYTES",
    "conformance.client._runs.MAX_LINES",
    "conformance.camera._wire.MAX_BODY_BYTES",
    "conformance.camera._raw_client.MAX_RECEIVED_BYTES",
    "conformance.camera._raw_client.MAX_LOG_LINES",
    "conformance.camera._raw_client.CLOSE_TIMEOUT",
    "conformance.camera._session_under_test.SESSION_ATTEMPTS",
    "conformance.camera._options.MAX_SECONDS",
    "conformance.camera._options.MAX_INPUT_DATA_BYTES",
    "conformance.camera._questions.MAX_CONTAINERS",
    "conformance.camera._questions.MAX_LEFT_CONTAINERS",
    "web._routes.MAX_BODY_BYTES",
    "web._routes.READ_TIMEOUT",
    "web._streams.MAX_STREAMS",
    "web._streams.PERIOD",
    "web._streams.READER_TIMEOUT",
    "web._emulator.MAX_ENTRIES",
    "web._emulator.MAX_WAIT",
    "web._emulator.MAX_WAITING_CALLS",
    "web._emulator.LOG_POLL_INTERVAL",
    "web._emulator.MAX_PARTS",
    "web._emulator.MAX_NAMES",
    "web._serialize.MAX_HEX_BYTES",
    "web._serialize.MAX_VALUES_BYTES",
    "web._serialize.MAX_REPLY_BYTES",
    "web._serialize.MAX_LISTED",
    "web._feed.MAX_LOG_NEWS",
    "web._feed.MAX_FAULTS_TOLD",
    "web._live.MAX_NEWS",
    "web._live.CHECKS_PER_CLOCK_REPORT",
    "web._live_view.MAX_RESULTS",
    "web._live_view.MAX_VALUE_CHARACTERS",
    "web._live_view.MAX_PARTS",
    "web._live_view.MAX_SHOWN_RAW_BYTES",
    "web._live_view.SERIES_DURATION",
    "web._live_view.IMAGE_PERIOD",
    "web._site.FINISH_TIMEOUT",
    "web._connections.MAX_CONNECTIONS",
    "web._connections.HEAD_TIMEOUT",
    "web._connections.KEEP_ALIVE_TIMEOUT",
    "web._connections.MAX_HEAD_BYTES",
    "_accepting.RESOLVE_TIMEOUT",
    "web._guard.MIN_TOKEN_CHARACTERS",
    "web._errors.MAX_SHOWN_CHARACTERS",
)
"""Constants that bound something, below ``smartcam.``."""


# ---------------------------------------------------------------------- tables made from the code


def _table(head: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    def line(cells: Iterable[object]) -> str:
        return "| " + " | ".join(str(cell).replace("|", "\\|") for cell in cells) + " |"

    head = list(head)
    return "\n".join([line(head), line("---" for _ in head), *map(line, rows)]) + "\n"


def _type_name(row: MessageRow) -> str:
    return f"`{row.type.__name__}`"


def _answer(row: MessageRow, dialect: FramedDialect) -> str:
    if not issubclass(row.type, Request):
        return ""
    answer = row.type.answer
    return f"`{answer.__name__}`" if answer and dialect.has(answer) else "none"


def _messages(dialect: FramedDialect) -> str:
    """Return every message with its id, its sender, its answer and its source."""
    rows = [
        (
            f"`{row.message_id:#04x}`",
            row.title,
            _type_name(row),
            row.type.sender.value,
            _answer(row, dialect),
            *row.source.rsplit(", ", 1),
        )
        for row in dialect.table
    ]
    head = ("id", "manual's name", "class", "from", "answer", "source", "grade")
    return _table(head, rows)


def _bodies(*dialects: FramedDialect) -> str:
    """Return every body field by field, and what the length fields of these dialects say."""
    dialect = dialects[0]
    types = {
        Wire.WORD: (WORDS[dialect.word], struct.calcsize(f"<{dialect.word}")),
        Wire.UINT32: ("UINT32", 4),
        Wire.DATA: ("bytes", None),
    }
    rows: list[tuple[object, ...]] = []
    for row in dialect.table:
        sizes = [types[wire][1] for _, wire in row.fields]
        known = sum(size for size in sizes if size)
        open_end = " + n" if None in sizes else ""
        lengths = [f"{known + d.header.length_includes}{open_end}" for d in dialects]
        start = [f"`{row.message_id:#04x}`", _type_name(row)]
        offset = dialect.header.size
        for name, wire in row.fields:
            kind, size = types[wire]
            rows.append((*start, offset, f"`{name}`", kind, size or "n", *lengths))
            start, lengths = ["", ""], [""] * len(lengths)
            offset += size or 0
        if not row.fields:
            rows.append((*start, "", "none", "", "", *lengths))
    names = [f"length in `{one.name}`" for one in dialects]
    return _table(("id", "class", "offset", "field", "type", "bytes", *names), rows)


def messages() -> str:
    """Return the messages of the dialects with a magic number."""
    return _messages(HANDBOOK)


def bodies() -> str:
    """Return their bodies."""
    return _bodies(HANDBOOK, THESIS)


def messages_b16() -> str:
    """Return the messages of ``b16``."""
    return _messages(B16)


def bodies_b16() -> str:
    """Return their bodies."""
    return _bodies(B16)


def messages_bid() -> str:
    """Return the messages of ``bid``."""
    return _messages(BID)


def bodies_bid() -> str:
    """Return their bodies."""
    return _bodies(BID)


def result_codes() -> str:
    """Return the result codes of ``bid``."""
    rows = [(f"`{int(c):#04x}`", code.text, code.verdict.value) for c, code in CODES.items()]
    return _table(("code", "meaning", "taken as"), rows)


def wire_quirks() -> str:
    """Return the deviations of dialects that a URL can name."""
    rows = [
        (f"`?dialect={dialect.name}&quirks={name}`", quirk.about, *quirk.source.rsplit(", ", 1))
        for dialect in BVS.dialects.values()
        for name, quirk in dialect.wire_quirks.items()
    ]
    return _table(("in a URL", "what differs", "source", "grade"), rows)


def dialects() -> str:
    """Return every protocol and dialect, over what it is spoken, and who says so."""
    rows: list[tuple[object, ...]] = []
    for info in PROTOCOLS.available():
        protocol = load_protocol(info.name)
        for dialect in protocol.dialects.values():
            ways = ", ".join(f"`{scheme}://`" for scheme in protocol.schemes)
            *source, grade = dialect.source.rsplit(", ", 1)
            rows.append(
                (f"`{info.name}`", f"`{dialect.name}`", ways, dialect.about, *source, grade)
            )
    return _table(("protocol", "dialect", "URL", "what it is", "source", "grade"), rows)


def abilities() -> str:
    """Return what a camera can do in each dialect, as ``camera.capabilities`` tells it."""
    found = [
        dialect.capabilities
        for info in PROTOCOLS.available()
        for dialect in load_protocol(info.name).dialects.values()
    ]
    names = [one.name for one in dataclasses.fields(found[0]) if one.name != "dialect"]
    rows = [(f"`{name}`", *("yes" if getattr(c, name) else "" for c in found)) for name in names]
    return _table(("", *(f"`{one.dialect}`" for one in found)), rows)


def quirks() -> str:
    """Return the emulator's open questions, as the descriptions of their fields tell them."""
    rows = [
        (f"`{name}`", f"`{field.default}`", _choices(field.annotation), field.description)
        for name, field in Quirks.model_fields.items()
    ]
    return _table(("quirk", "default", "values", "why"), rows)


def quirks_insight() -> str:
    """Return those of the emulated In-Sight camera."""
    rows = [
        (f"`{name}`", f"`{field.default}`", _choices(field.annotation), field.description)
        for name, field in InSightQuirks.model_fields.items()
    ]
    return _table(("quirk", "default", "values", "why"), rows)


def application() -> str:
    """Return the fields of an application of the emulator."""
    return _fields(Application)


def scenario() -> str:
    """Return the fields of a scenario of one camera."""
    return _fields(Scenario).replace("| below |", "|  |")


def cue() -> str:
    """Return the fields of a cue."""
    return _fields(Cue)


def faults_which() -> str:
    """Return the fields that say which message a fault is about."""
    fields = faults.FAULTS["drop"].model_fields
    return _table(
        ("field", "meaning"),
        [(f"`{name}`", fields[name].description) for name in ("on", "sender", "nth", "times")],
    )


def faults_wire() -> str:
    """Return the faults of the wire."""
    return _faults(WireFault)


def faults_device() -> str:
    """Return the faults of the device."""
    return _faults(DeviceFault)


def _faults(family: type[BaseModel]) -> str:
    shared = {"kind", "on", "sender", "nth", "times", "when"}
    rows = []
    for kind, made in faults.FAULTS.items():
        if not issubclass(made, family):
            continue
        about = (inspect.getdoc(made) or "").partition("\n")[0].replace("``", "`")
        fields = [
            f"`{name}`: {field.description}"
            for name, field in made.model_fields.items()
            if name not in shared
        ]
        both_ways = issubclass(made, WireFault) and Sender.CLIENT in made.senders
        rows.append((f"`{kind}`{' *' if both_ways else ''}", about, "<br>".join(fields)))
    return _table(("kind", "what happens", "fields"), rows)


def settings() -> str:
    """Return the options of ``connect()``."""
    usual = CameraSettings(address=parse_address("camera"))
    rows = [
        (f"`{name}`", f"`{getattr(usual, name)!r}`", about) for name, (_, about) in OPTIONS.items()
    ]
    return _table(("option", "default", "meaning"), rows)


def fleet_file() -> str:
    """Return the fields of a fleet file."""
    return _fields(FleetFile)


def fleet_camera() -> str:
    """Return those of a camera in it."""
    return _fields(CameraEntry)


def fleet_emulated() -> str:
    """Return those of emulated ones."""
    return _fields(Emulated)


def fleet_frames() -> str:
    """Return those of its ``frames``."""
    return _fields(FramesEntry)


def fleet_reconnect() -> str:
    """Return those of its ``reconnect``."""
    return _fields(Retry)


def fleet_history() -> str:
    """Return those of its ``history``."""
    return _fields(History)


def fleet_operations() -> str:
    """Return those of its ``operations``."""
    return _fields(OperationsSection)


def fleet_record() -> str:
    """Return those of its ``record``."""
    return _fields(RecordSection)


def fleet_standby() -> str:
    """Return those of its ``standby``."""
    return _fields(Standby)


def fleet_ros2() -> str:
    """Return those of its ``ros2``."""
    return _fields(RosSection)


def fleet_ros2_camera() -> str:
    """Return those of a camera's ``ros2``."""
    return _fields(RosCamera)


def access_rights() -> str:
    """Return who may what in a fleet, and with which keys."""
    rows = [
        (
            right.what,
            USES[right.use],
            " ".join(f"`{key.removeprefix('smartcam/*/')}`" for key in right.keys),
            *("yes" if role in right.roles else "" for role in ROLES[:3]),
        )
        for right in RIGHTS
    ]
    return _table(("may", "how", "keys behind `smartcam/FLEET/`", *ROLES[:3]), rows)


def calls_emulator() -> str:
    """Return the calls of the emulator's page."""
    return _calls(emulator_page.CALLS)


def calls_colours() -> str:
    """Return the calls of the page of colours."""
    return _calls(colour_page.CALLS)


def calls_cloud() -> str:
    """Return the calls of the page of clouds."""
    return _calls(cloud_page.CALLS)


def calls_wizard() -> str:
    """Return the calls of the page of a calibration."""
    return _calls(wizard_page.CALLS)


def calls_live() -> str:
    """Return the calls of the page of one camera."""
    return _calls(live_page.CALLS)


def calls_frames() -> str:
    """Return the calls of the page of pictures."""
    return _calls(frames_page.CALLS)


def calls_fleet() -> str:
    """Return the calls of the page of a fleet, without those of one camera."""
    return _calls(one for one in fleet_page.CALLS if "{camera}" not in one.path)


def _calls(calls: Iterable[Any]) -> str:
    rows = [
        (call.method, f"`{call.path}`", call.about, f"`{call.sample}`" if call.sample else "")
        for call in calls
    ]
    return _table(("method", "path", "what it does", "body, for example"), rows)


def _fields(kind: type[BaseModel]) -> str:
    rows = [
        (f"`{name}`", field.description, _default(field))
        for name, field in kind.model_fields.items()
    ]
    return _table(("field", "what it says", "default"), rows)


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "has to be there"
    if field.default is None or field.default_factory is not None:
        return ""
    return "below" if isinstance(field.default, BaseModel) else f"`{json.dumps(field.default)}`"


def transitions() -> str:
    """Return the session's states and what leads from one to another."""
    ways: dict[tuple[State, State], dict[Sender, list[str]]] = {}
    for (state, sender, message), following in TRANSITIONS.items():
        ways.setdefault((state, following), {}).setdefault(sender, []).append(message.__name__)
    lines: list[str] = []
    for state in State:
        for (start, following), senders in ways.items():
            if start is state:
                lines.append(f"{state.name} --> {following.name}")
                lines += [f"    {who.value} sends {_wrap(names)}" for who, names in senders.items()]
    inner = " | ".join(state.name for state in State if state not in {State.CLOSED, State.FAILED})
    lines += [f"{inner} --> CLOSED", "    the peer ends the link"]
    lines += [f"{inner} --> FAILED", "    broken input, where the policy says so"]
    return "```text\n" + "\n".join(lines) + "\n```\n"


def _wrap(names: list[str]) -> str:
    return ("\n" + 17 * " ").join(textwrap.wrap(", ".join(names), 60))


def policies() -> str:
    """Return what each role does with broken input."""
    surplus = f"is accepted and counted; by more than {MAX_SURPLUS_BYTES:,} bytes it is broken"
    rows = [
        (
            role.value,
            transport.value.upper(),
            "ends the link" if policy.fatal else "is dropped and counted",
            "is broken" if policy.exact_length else surplus,
        )
        for (role, transport), policy in POLICIES.items()
    ]
    return _table(("role", "transport", "broken input", "a body longer than documented"), rows)


def layers() -> str:
    """Return the import contracts that are layers, the top first."""
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
    contracts = tools["importlinter"]["contracts"]
    found = [one for one in contracts if one["type"] == "layers"]
    texts = ["\n".join([*one["containers"], "", *one["layers"]]) for one in found]
    return "\n".join(f"```text\n{text.replace(' :', ',')}\n```\n" for text in texts)


def modules() -> str:
    """Return each module with the first line of its docstring."""
    rows: list[tuple[str, str, str]] = []
    for path in sorted((ROOT / "smartcam").rglob("*.py")):
        text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
        first = re.sub(r":\w+:`[~.]?(?:[\w.]+\.)?(\w+)`", r"`\1`", text.split("\n\n")[0])
        folder = ".".join(path.relative_to(ROOT).parent.parts)
        rows.append((f"`{folder}`", f"`{path.stem}`", " ".join(first.replace("``", "`").split())))
    return _table(("in", "module", "holds"), rows)


def public_names() -> str:
    """Return the number of public names of each module; a name of two modules counts once."""
    modules: dict[str, list[str]] = {}
    for path in sorted((ROOT / "smartcam").rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        found = re.search(
            r"^__all__ = (\[.*?\])", path.read_text("utf-8"), re.MULTILINE | re.DOTALL
        )
        if found and "._" not in name:
            modules[name] = ast.literal_eval(found[1])
    modules["smartcam"] = modules.pop("smartcam")  # last: most of its names are those of others
    seen: set[str] = set()
    rows: list[tuple[str, int]] = []
    for module, names in modules.items():
        rows.append((f"`{module}`", len(set(names) - seen)))
        seen.update(names)
    return _table(("module", "names"), [*rows, ("together", len(seen))])


def limits() -> str:
    """Return the constants of :data:`LIMITS` with their values and the reasons in the source."""
    rows: list[tuple[object, ...]] = []
    for path in LIMITS:
        place, _, name = path.rpartition(".")
        module = importlib.import_module(f"smartcam.{place}")
        reason = " ".join(_constant_doc(module, name).split())
        rows.append((f"`{path}`", f"{getattr(module, name):,}", reason))
    return _table(("constant", "value", "why"), rows)


def _choices(annotation: Any) -> str:
    if typing.get_origin(annotation) is typing.Literal:
        return ", ".join(f"`{value}`" for value in typing.get_args(annotation))
    names = {bool: "true or false", float: "seconds", int: "a number"}
    return names.get(annotation, str(annotation))


def _constant_doc(module: Any, name: str) -> str:
    """Return the text that stands below a constant in the source."""
    body = ast.parse(inspect.getsource(module)).body
    for node, following in itertools.pairwise(body):
        targets = getattr(node, "targets", [getattr(node, "target", None)])
        if name in {getattr(target, "id", None) for target in targets}:
            text = getattr(getattr(following, "value", None), "value", "")
            return text if isinstance(text, str) else ""
    return ""


GENERATED: dict[str, Callable[[], str]] = {
    one.__name__: one
    for one in (
        *(messages, bodies, messages_b16, bodies_b16, messages_bid, bodies_bid),
        *(result_codes, wire_quirks, dialects, abilities),
        *(quirks, quirks_insight, settings, transitions, policies, layers, limits),
        *(modules, public_names),
        *(application, scenario, cue, faults_which, faults_wire, faults_device),
        *(fleet_file, fleet_camera, fleet_emulated, fleet_frames, fleet_reconnect, fleet_history),
        *(fleet_operations, fleet_record, fleet_standby, fleet_ros2, fleet_ros2_camera),
        *(access_rights, calls_emulator, calls_colours, calls_cloud),
        *(calls_wizard, calls_live, calls_frames, calls_fleet),
    )
}
"""What ``{generated}`` knows."""


def setup(app: Any) -> None:
    """Sphinx: add the directive ``{generated}``."""
    from docutils import nodes
    from docutils.statemachine import StringList
    from sphinx.util.docutils import SphinxDirective

    class Generated(SphinxDirective):
        """Puts a table made from the code into the page."""

        required_arguments = 1

        def run(self) -> list[nodes.Node]:
            text = GENERATED[self.arguments[0]]()
            box = nodes.container(classes=["generated"])
            source = StringList(text.splitlines(), source=f"generated {self.arguments[0]}")
            self.state.nested_parse(source, self.content_offset, box)
            return box.children

    app.add_directive("generated", Generated)
    app.connect("source-read", _link_results)
    app.connect("autodoc-skip-member", _skip)
    app.connect("autodoc-process-docstring", _tell_returned, priority=400)  # before napoleon
    app.connect("autodoc-process-signature", _plain_types)
    app.connect("autodoc-process-signature", _which_frame)


def _link_results(_app: Any, _name: str, source: list[str]) -> None:
    """Let a page's links to results, which are no pages, lead to these files."""
    for way in ("../results/", "../../results/"):
        source[0] = source[0].replace(f"]({way}", f"](path:{way}")


def _plain_types(
    _app: Any, _what: str, _name: str, member: Any, *rest: Any
) -> tuple[str, str] | None:
    """Show the types of a stored class' fields without how they stand in a file."""
    fields = (
        inspect.isclass(member) and issubclass(member, Stored) and dataclasses.is_dataclass(member)
    )
    if not fields:
        return None
    from sphinx.util.inspect import stringify_signature

    types = typing.get_type_hints(member)
    given = inspect.signature(member).parameters.values()
    shown = inspect.Signature([one.replace(annotation=types[one.name]) for one in given])
    array = "numpy.ndarray[tuple[typing.Any, ...], numpy.dtype[numpy.float64]]"
    return stringify_signature(shown).replace(array, "Array"), ""


def _which_frame(
    _app: Any, _what: str, name: str, _member: Any, _options: Any, signature: str, gives: str
) -> tuple[str | None, str | None]:
    """Say whose frame it is: a camera's, or a protocol's."""
    home = "protocols" if name.startswith("smartcam.protocols") else "frames"

    def named(text: str | None) -> str | None:
        return text and re.sub(r"(?<![\w.])Frame(?!\w)", f"~smartcam.{home}.Frame", text)

    return named(signature), named(gives)


class _Returned(typing.NamedTuple):
    """A class that functions return and no module exports.

    Attributes:
        lines: its docstring, and what its methods do.
        gives: words in the types that its methods return.
    """

    lines: list[str]
    gives: frozenset[str]


@functools.cache
def _returned_classes() -> dict[str, _Returned]:
    """Return the classes that no module exports and that have attributes or methods to tell."""
    exported: set[str] = set()
    found: dict[str, _Returned] = {}
    for path in sorted((ROOT / "smartcam").rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                text, (methods, gives) = ast.get_docstring(node) or "", _methods(node)
                if "\nAttributes:\n" in text or methods:
                    found[node.name] = _Returned([*text.splitlines(), *methods], gives)
            elif isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
                exported.update(ast.literal_eval(node.value) if path.stem != "_inside" else ())
    return {name: one for name, one in found.items() if name not in exported}


def _methods(node: ast.ClassDef) -> tuple[list[str], frozenset[str]]:
    """Return a list of a class' public methods and properties, and words of what they return."""
    lines: list[str] = []
    gives: set[str] = set()
    for one in node.body:
        if not isinstance(one, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if one.name[0] != "_" or one.name in {"__getitem__", "__aiter__", "__anext__"}:
            gives.update(re.findall(r"\w+", ast.unparse(one.returns) if one.returns else ""))
        text = (ast.get_docstring(one) or "").partition("\n\n")[0]
        if text and one.name[0] != "_":
            is_property = any(getattr(mark, "id", "") == "property" for mark in one.decorator_list)
            taken = ast.unparse(one.args).removeprefix("self").removeprefix(", ")
            given = "" if is_property else f"({taken})"
            lines.append(f"- ``{one.name}{given}``: {' '.join(text.split())}")
    return (["", *lines] if lines else []), frozenset(gives)


def _tell_returned(
    _app: Any, _what: str, _name: str, member: Any, _options: Any, lines: list[str]
) -> None:
    """Add what a function returns, or a field holds, if its class is not in the reference."""
    types = getattr(getattr(member, "fget", member), "__annotations__", {})
    if inspect.isclass(member) and hasattr(member, "model_fields"):
        return  # what pydantic reads is described by its fields
    gives = types.values() if inspect.isclass(member) else [types.get("return")]
    waiting = re.findall(r"\w+", " ".join(map(str, gives)))
    told: set[str] = set()
    while waiting:
        name = waiting.pop(0)
        one = _returned_classes().get(name)
        if (
            one is None
            or name in told
            or (inspect.isclass(member) and "Attributes:" not in one.lines)
        ):
            continue
        told.add(name)
        first, *rest = one.lines
        lines += ["", f"``{name}``: {first}", *rest]
        waiting += [] if inspect.isclass(member) else sorted(one.gives)


def _skip(_app: Any, _what: str, _name: str, member: object, skip: bool, _options: Any) -> bool:
    """Leave out a NamedTuple's fields: its docstring describes them."""
    text = getattr(member, "__doc__", None) or ""
    return skip or text.startswith("Alias for field number")
