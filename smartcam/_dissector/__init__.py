"""A Wireshark dissector for every dialect of ``bvs``, made from the message tables.

The message tables of ``protocols/_bvs.py`` become Lua tables, with which ``engine.lua`` in this
folder reads frames. So a message that is added there is known to Wireshark, too.
"""

from __future__ import annotations

from importlib import resources
from typing import TYPE_CHECKING, Any

from smartcam import __version__
from smartcam.models import Status
from smartcam.protocols import BVS, Transport
from smartcam.protocols._inside import DEFAULT_MAX_LENGTH, DEFAULT_PORT
from smartcam.protocols.messages import Request, Sender

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from smartcam.protocols import CodeMeaning, FramedDialect, MessageRow, StatusBits

Rows = dict[str, dict[int, dict[str, Any]]]
"""Messages of a dialect: by sender, then by message id."""


def lua_source() -> str:
    """Return the dissector: one Lua file for Wireshark 3.6 and later, ASCII.

    It registers the protocol ``bvs`` on the camera's port over TCP and UDP, and for frames that
    begin with a magic number on any port.
    """
    engine = resources.files(__name__).joinpath("engine.lua").read_text(encoding="ascii")
    lines = [
        f"-- Wireshark dissector for Balluff BVS smart cameras, made by smartcam {__version__}.",
        "-- Do not edit: smartcam dissector > smartcam.lua makes it anew from the message tables.",
        "",
        *(f"local {name} = {_lua_expression(value)}" for name, value in lua_tables().items()),
        "",
    ]
    return "\n".join(lines) + engine


def lua_tables() -> dict[str, Any]:
    """Return the tables of the Lua code, as plain values by the names of the Lua variables."""
    dialects = BVS.dialects
    rows = [row for dialect in dialects.values() for row in dialect.table]
    detected_dialects = [dialect for group in BVS.detection[Transport.TCP] for dialect in group]
    return {
        "PORT": DEFAULT_PORT,
        "MAX_LENGTH": DEFAULT_MAX_LENGTH,
        "FIELDS": {name: wire.value for row in rows for name, wire in row.fields},
        "STATUSES": [_status_name(member) for member in Status],
        "IDS": _names_by_id(rows),
        "DIALECTS": [_dialect_table(dialect) for dialect in dialects.values()],
        "TRIED_TOGETHER": [[dialect.name, *dialect.quirks] for dialect in detected_dialects],
    }


def _dialect_table(dialect: FramedDialect) -> dict[str, Any]:
    header = dialect.header
    rows_without_quirk = _dialect_rows(dialect)
    return {
        "name": dialect.name,
        "about": dialect.about,
        "magic": header.magic.hex(),
        "word": 4 if dialect.word == "I" else 2,
        "number": 4 if header.code == "I" else 2,
        "id_first": header.id_first,
        "length_includes": header.length_includes,
        "unasked_status": dialect.unasked_status,
        "status": _status_table(dialect.status_bits),
        "codes": _code_table(dialect.codes),
        "messages": rows_without_quirk,
        "quirks": [
            _quirk_differences(dialect.with_quirks([name]), rows_without_quirk)
            for name in dialect.wire_quirks
        ],
    }


def _quirk_differences(variant: FramedDialect, rows_without_quirk: Rows) -> dict[str, Any]:
    """Return the differences of a dialect with one quirk from the dialect without it."""
    (name,) = variant.quirks
    return {
        "name": name,
        "about": variant.wire_quirks[name].about,
        "codes": _code_table(variant.codes) if variant.wire_quirks[name].codes is not None else {},
        "messages": {
            sender: {
                message_id: row
                for message_id, row in rows.items()
                if row != rows_without_quirk[sender][message_id]
            }
            for sender, rows in _dialect_rows(variant).items()
        },
    }


def _dialect_rows(dialect: FramedDialect) -> Rows:
    rows: Rows = {sender.value: {} for sender in Sender}
    for row in dialect.table:
        rows[row.type.sender.value][row.message_id] = _row_table(row, dialect)
    return rows


def _row_table(row: MessageRow, dialect: FramedDialect) -> dict[str, Any]:
    codec = dialect.encoder(row.type)
    return {
        "name": row.type.__name__,
        "title": row.title,
        "source": row.source,
        "fields": [[name, wire.value] for name, wire in row.fields],
        "size": codec.size,
        "data": codec.has_data,
        "big_endian": row.byte_order == ">",
        "code_alone": codec.may_be_code_only,
        "answered": issubclass(row.type, Request) and dialect.answers(row.type),
    }


def _code_table(codes: Mapping[int, CodeMeaning]) -> dict[int, list[str]]:
    return {int(number): [code.text, code.verdict.value] for number, code in codes.items()}


def _status_name(status: Status) -> str:
    return (status.name or "").lower()


def _status_table(bits: StatusBits) -> dict[str, Any]:
    """Return the names of the bits of the status on the wire, under keys named as in StatusBits.

    A bit that is not in ``bits.named`` means the bit ``bit << bits.unnamed_shift`` of Status.
    """
    if bits.unnamed_shift:
        status_by_bit = {member.value >> bits.unnamed_shift: member for member in Status}
        status_by_bit.update(bits.named)
        status_by_bit.pop(0, None)
    else:
        status_by_bit = {member.value: member for member in Status if member.value < 1 << 32}
    return {
        "named": [[wire, _status_name(status_by_bit[wire])] for wire in sorted(status_by_bit)],
        "inverted": [[wire, _status_name(status)] for wire, status in bits.inverted.items()],
        "always": [_status_name(member) for member in bits.always],
    }


def _names_by_id(rows: Sequence[MessageRow]) -> dict[int, str]:
    """Return the names of the messages that have each id, requests first."""
    names: dict[int, dict[str, None]] = {}
    for row in sorted(rows, key=lambda row: row.type.sender is Sender.CAMERA):
        names.setdefault(row.message_id, {})[row.type.__name__] = None
    return {number: " / ".join(texts) for number, texts in sorted(names.items())}


def _lua_expression(value: Any, indent: str = "") -> str:
    """Return a value as a Lua expression; tables have a line for each entry."""
    match value:
        case bool():
            return "true" if value else "false"
        case int():
            return str(int(value))
        case str():
            return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
        case dict():
            entries = [(f"[{_lua_expression(key)}] = ", item) for key, item in value.items()]
        case _:
            entries = [("", item) for item in value]
    if not any(isinstance(item, (dict, list)) for _, item in entries):
        return "{" + ", ".join(key + _lua_expression(item) for key, item in entries) + "}"
    inner_indent = indent + "  "
    lines = [
        f"{inner_indent}{key}{_lua_expression(item, inner_indent)},\n" for key, item in entries
    ]
    return "{\n" + "".join(lines) + indent + "}"
