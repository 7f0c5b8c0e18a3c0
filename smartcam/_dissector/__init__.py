"""A Wireshark dissector for every dialect of ``bvs``, made from the message tables.

The tables become Lua tables, with which ``engine.lua`` beside this file reads frames. So a new
message in ``protocols/_bvs.py`` is known to Wireshark, too.
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
        *(f"local {name} = {_lua(value)}" for name, value in lua_tables().items()),
        "",
    ]
    return "\n".join(lines) + engine


def lua_tables() -> dict[str, Any]:
    """Return the tables of the Lua code, as plain values by the names of its variables."""
    dialects = BVS.dialects
    rows = [row for dialect in dialects.values() for row in dialect.table]
    first_tries = BVS.detection[Transport.TCP]
    return {
        "PORT": DEFAULT_PORT,
        "MAX_LENGTH": DEFAULT_MAX_LENGTH,
        "FIELDS": {name: wire.value for row in rows for name, wire in row.fields},
        "STATUSES": [_name(member) for member in Status],
        "IDS": _ids(rows),
        "DIALECTS": [_dialect(dialect) for dialect in dialects.values()],
        "KIN": [[dialect.name, *dialect.quirks] for group in first_tries for dialect in group],
    }


def _dialect(dialect: FramedDialect) -> dict[str, Any]:
    header = dialect.header
    plain = _rows(dialect)
    return {
        "name": dialect.name,
        "about": dialect.about,
        "magic": header.magic.hex(),
        "word": 4 if dialect.word == "I" else 2,
        "number": 4 if header.code == "I" else 2,
        "id_first": header.id_first,
        "length_includes": header.length_includes,
        "status_by_itself": dialect.status_by_itself,
        "status": _status(dialect.status_bits),
        "codes": _codes(dialect.codes),
        "messages": plain,
        "quirks": [_quirk(dialect.with_quirks([name]), plain) for name in dialect.wire_quirks],
    }


def _quirk(variant: FramedDialect, plain: Rows) -> dict[str, Any]:
    """Return the differences of a variant with one quirk."""
    (name,) = variant.quirks
    return {
        "name": name,
        "about": variant.wire_quirks[name].about,
        "codes": _codes(variant.codes) if variant.wire_quirks[name].codes is not None else {},
        "messages": {
            sender: {number: row for number, row in rows.items() if row != plain[sender][number]}
            for sender, rows in _rows(variant).items()
        },
    }


def _rows(dialect: FramedDialect) -> Rows:
    rows: Rows = {sender.value: {} for sender in Sender}
    for row in dialect.table:
        rows[row.type.sender.value][row.message_id] = _row(row, dialect)
    return rows


def _row(row: MessageRow, dialect: FramedDialect) -> dict[str, Any]:
    codec = dialect.encoder(row.type)
    return {
        "name": row.type.__name__,
        "title": row.title,
        "source": row.source,
        "fields": [[name, wire.value] for name, wire in row.fields],
        "size": codec.size,
        "data": codec.has_data,
        "big_endian": row.byte_order == ">",
        "code_alone": codec.may_be_a_code,
        "answered": issubclass(row.type, Request) and dialect.answers(row.type),
    }


def _codes(codes: Mapping[int, CodeMeaning]) -> dict[int, list[str]]:
    return {int(number): [code.text, code.verdict.value] for number, code in codes.items()}


def _name(status: Status) -> str:
    return (status.name or "").lower()


def _status(bits: StatusBits) -> dict[str, Any]:
    """Return the status bits of the wire by the attributes of StatusBits.

    Statuses without a place of their own are shifted up by ``others`` bits.
    """
    if bits.others:
        named = {member.value >> bits.others: member for member in Status}
        named.update(bits.named)
        named.pop(0, None)
    else:
        named = {member.value: member for member in Status if member.value < 1 << 32}
    return {
        "named": [[wire, _name(named[wire])] for wire in sorted(named)],
        "without": [[wire, _name(status)] for wire, status in bits.without.items()],
        "always": [_name(member) for member in bits.always],
    }


def _ids(rows: Sequence[MessageRow]) -> dict[int, str]:
    """Return the names of the messages with each id, requests first."""
    names: dict[int, dict[str, None]] = {}
    for row in sorted(rows, key=lambda row: row.type.sender is Sender.CAMERA):
        names.setdefault(row.message_id, {})[row.type.__name__] = None
    return {number: " / ".join(texts) for number, texts in sorted(names.items())}


def _lua(value: Any, indent: str = "") -> str:
    """Return a value as a Lua expression; tables have a line for each entry."""
    match value:
        case bool():
            return "true" if value else "false"
        case int():
            return str(int(value))
        case str():
            return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
        case dict():
            entries = [(f"[{_lua(key)}] = ", item) for key, item in value.items()]
        case _:
            entries = [("", item) for item in value]
    if not any(isinstance(item, (dict, list)) for _, item in entries):
        return "{" + ", ".join(key + _lua(item) for key, item in entries) + "}"
    deeper = indent + "  "
    lines = [f"{deeper}{key}{_lua(item, deeper)},\n" for key, item in entries]
    return "{\n" + "".join(lines) + indent + "}"
