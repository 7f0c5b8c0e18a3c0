"""The table of targets: what is fuzzed, with which limits and which words."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from smartcam.emulator.generators import generator_names
from smartcam.interpreters.localizations import Localizations
from smartcam.layout.text import TYPES, UNITS
from smartcam.protocols.bvs import B16, BVS, MESSAGES, MessageId

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = ["CORPUS", "TARGETS", "Target"]

CORPUS = Path(__file__).parent / "corpus"


class Target(NamedTuple):
    """One target; its module is ``fuzz_NAME``.

    Attributes:
        name: its name.
        max_length: bytes of an input at most.
        share: of ``--runs``, in proportion to the others: the fast ones get more.
        words: what its inputs are made of, for whoever changes them.
    """

    name: str
    max_length: int
    share: int
    words: tuple[bytes, ...] = ()

    @property
    def corpus(self) -> Path:
        """Its folder of inputs."""
        return CORPUS / self.name

    def load(self) -> Callable[[bytes], None]:
        """Return its ``check``, which raises where it finds something."""
        check: Callable[[bytes], None] = importlib.import_module(f"fuzz_{self.name}").check
        return check


def _words(*texts: str) -> tuple[bytes, ...]:
    return tuple(text.encode() for text in texts)


_HEADERS = (
    *(one.header.magic for one in BVS.dialects.values() if one.header.magic),
    *sorted({row.message_id.to_bytes(4, "little") for row in MESSAGES}),
    *(bytes((int(number), 0, 2, 0)) for number in MessageId),
    *(bytes.fromhex(one) for one in ("00000000", "04000000", "08000000", "ffffffff", "0100")),
)
_LAYOUT = (
    *_words(*(f"{name}: {name}" for name in TYPES), *TYPES, "string[9]"),
    *(f" {unit}".encode() for unit in UNITS),
    *_words(
        " @sequence", "n: int8, ", "(", ")*", ")[n]", ")[3]", "g: (", ", ", "# ", "\n", "\uff41"
    ),
)
_NUMBERS = tuple(
    bytes.fromhex(one) for one in ("0000807f", "0000c07f", "0100807f", "000000000000f07f", "ff")
)
_YAML = _words(
    *("!!int ", "!!float ", "!!bool ", "!!null ", "!!timestamp ", "!!binary ", "!!set ", "!!str "),
    *("!!omap ", "!!pairs ", "!!seq ", "!!map ", "!<tag:yaml.org,2002:value> ", "! ", "&a ", "*a"),
    *("<<: ", "? ", ": ", "- ", "\n  ", "---\n", "...\n", "|\n", ">\n", "{", "}", "[", "]", '"'),
    *(
        "~",
        ".inf",
        ".nan",
        "1e9",
        "0x7fffffff",
        "0b1",
        "1:30",
        "2001-01-01",
        "true",
        "=",
        "\\ud800",
    ),
)
_SCENARIO = _words(
    *("name: ", "active: ", "running: ", "builtins: ", "seed: ", "applications:\n  - ", "quirks: "),
    *("id: 5", "layout: ", "rate: ", "load_time: ", "processing_time: ", "input: ", "slots: "),
    *("constant: ", "cycle: ", "generator: ", "parameters: ", "pieces: ", "field: "),
    *(f"generator: {name}" for name in generator_names()),
    *(
        "faults:\n  - ",
        "kind: drop",
        "kind: insert",
        "on: Trigger",
        "nth: 2",
        "times: 3",
        "data: ff",
    ),
    *("bad_frame: ", "reboot_time: ", "input_queue_depth: ", "n: int32", "{n: 1}"),
)
_LAYOUT_FILE = _words(
    *("fields:\n- ", "head:\n- ", "name: ", "type: ", "unit: ", "sequence: true\n", "repeat: '*'"),
    *("group: ", "lenient: true\n", "repeat: 3", "repeat: n", "{name: x, type: int32}"),
)
_ADDRESS = _words(
    *(f"{scheme}://" for scheme in (*BVS.schemes, "insight")),
    *("127.0.0.1", "[::1]", "[fe80::1%25eth0]", "localhost", ":36701", "?dialect=", "&", "#", "@"),
    *("&quirks=", *B16.wire_quirks, ",", "me:secret@", "?user=", "&timeout="),
    *(*BVS.dialects, "%5B", "xn--", "ⓑ", "[v1.a]", "/", "\\", "\u3002", "\uff0f", "\u200b"),
)
_SPEC = _words(
    *("localizations", "strings50", "50ByteStrings", "Localizations", "record", "table", "raw"),
    *(": ", Localizations.default_layout or "", "table: int32", "records: ("),
)

TARGETS = {
    target.name: target
    for target in (
        Target("framing", 80, 22, _HEADERS),
        Target("messages", 64, 12, _HEADERS),
        Target("machine", 128, 8, _HEADERS),
        Target("layout", 256, 3, _LAYOUT + _NUMBERS),
        Target("interpreters", 160, 6, _NUMBERS),
        Target("scenario", 1024, 2, _SCENARIO + _LAYOUT + _YAML),
        Target("camera", 128, 1, _HEADERS),
        Target("layout_file", 256, 2, _LAYOUT + _YAML + _LAYOUT_FILE),
        Target("address", 96, 22, _ADDRESS),
        Target("spec", 128, 22, _SPEC + _LAYOUT),
    )
}
"""Every target by name, in the order in which they run."""
