"""The table of targets: what is fuzzed, with which limits and which words."""

from __future__ import annotations

import importlib
import re
import tomllib
import traceback
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from smartcam.interpreters._inside import LocalizationsInterpreter
from smartcam.layout._inside import TYPES, UNITS
from smartcam.protocols import BVS
from smartcam.protocols._inside import MessageId
from tests.emulator.parts import generator_names
from tests.machines import B16, MESSAGES

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

CORPUS = Path(__file__).parent / "corpus"
FINDINGS = CORPUS / "findings.toml"


class Target(NamedTuple):
    """One target: ``check`` of the module ``fuzz_NAME``, or ``check_NAME`` of one that it shares.

    Attributes:
        name: its name.
        max_length: bytes of an input at most.
        share: of ``--runs``, in proportion to the others: the fast ones get more.
        words: what its inputs are made of, for whoever changes them.
        shares: ``texts`` where it stands with others in ``fuzz_texts``; the whole name of a module
            of a room's tests.
    """

    name: str
    max_length: int
    share: int
    words: tuple[bytes, ...] = ()
    shares: str = ""

    @property
    def archive(self) -> Path:
        """The inputs that together reach everything, by their hash."""
        return CORPUS / f"{self.name}.zip"

    def reached(self) -> dict[str, bytes]:
        """Return the inputs of the archive by name."""
        with zipfile.ZipFile(self.archive) as archive:
            return {name: archive.read(name) for name in sorted(archive.namelist())}

    def findings(self) -> dict[str, bytes]:
        """Return the inputs that were findings once, by name."""
        return {
            row["name"]: row["text"].encode() if "text" in row else bytes.fromhex(row["hex"])
            for row in tomllib.loads(FINDINGS.read_text(encoding="utf-8"))["finding"]
            if self.name in row["targets"]
        }

    def inputs(self) -> dict[str, bytes]:
        """Return all of them."""
        return self.reached() | self.findings()

    def keep(self, inputs: Mapping[str, bytes]) -> None:
        """Write the archive; the same inputs give the same bytes."""
        with zipfile.ZipFile(self.archive, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, data in sorted(inputs.items()):
                archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED)

    def load(self) -> Callable[[bytes], None]:
        """Return its check, which raises where it finds something."""
        name = self.shares or self.name
        module = importlib.import_module(name if "." in name else f"tests.fuzz.fuzz_{name}")
        check: Callable[[bytes], None] = getattr(
            module, f"check_{self.name}" if self.shares else "check"
        )
        return check


def _words(*texts: str) -> tuple[bytes, ...]:
    return tuple(text.encode() for text in texts)


_HEADERS = (
    *(one.header.magic for one in BVS.dialects.values() if one.header.magic),
    *sorted({row.message_id.to_bytes(4, "little") for row in MESSAGES}),
    *(bytes((int(number), 0, 2, 0)) for number in MessageId),
    *(bytes.fromhex(one) for one in ("00000000", "04000000", "08000000", "ffffffff", "0100")),
)
_MAKES = _words(
    *("1000L000000008\r\n1000", "0000L000000008\r\n0000", "L000000005\r\n", "1002", "*\r\n", "!"),
    *("IFM ELECTRONIC", "110001006:", "003\t07\t01\t07\t12", "smartcam;", "000000000", "?\r\n"),
    *("RT,00001,OK", ",01,NG,0000095", "PR,007\r", "PW\r", "ER,T2,03\r", "ER,LON,20\r", "ERROR\r"),
    *("OK,NUM,1,0\r", "OK,BUSYSTAT,NONE\r", "4006381333931\r"),
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
    *(f"{scheme}://" for scheme in (*BVS.schemes, "insight", "pcic", "iv3", "sr")),
    *("127.0.0.1", "[::1]", "[fe80::1%25eth0]", "localhost", ":36701", "?dialect=", "&", "#", "@"),
    *("&quirks=", *B16.wire_quirks, ",", "me:secret@", "?user=", "&timeout="),
    *(*BVS.dialects, "%5B", "xn--", "ⓑ", "[v1.a]", "/", "\\", "\u3002", "\uff0f", "\u200b"),
)
_SPEC = _words(
    *("localizations", "strings50", "50ByteStrings", "Localizations", "record", "table", "raw"),
    *(": ", LocalizationsInterpreter.default_layout or "", "table: int32", "records: ("),
)
_CELL = _words(
    *("cameras:\n  cam: ", "software: ", "frames: x", "applications: ", "calibration: c.json"),
    *("{7: {", "name: a", "sequence: true", "rate: 5", "keep: {folder: k}", "drawn: false"),
    *("read: ", "present: ", "compare: ", "measure: ", "present two: ", "follow: a", "region: "),
    *("[0, 0, 9, 9]", "[[0, 0], [9, 0], [9, 9]]", "grey: [0, 90]", "codes: [QRCode]", "expect: "),
    *("(a+)+", "[0-9]{12}", "width: {across: [[1, 1], [9, 1]]}", "tolerance: 9 +- 1 px", "most: 5"),
    *("circle: {centre: [9, 9], radius: 5}", "line: {along: [[1, 1], [9, 1]]}", "guard: 0"),
)
_GS1 = _words("\x1d", "01", "10", "3103", "8005", "21", "00", "9", "04012345678901", "\u00b2")

TARGETS = {
    target.name: target
    for target in (
        Target("framing", 80, 22, _HEADERS),
        Target("messages", 64, 12, _HEADERS),
        Target("machine", 128, 8, _HEADERS),
        Target("makes", 160, 6, _MAKES),
        Target("layout", 256, 3, _LAYOUT + _NUMBERS),
        Target("interpreters", 160, 6, _NUMBERS),
        Target("scenario", 1024, 2, _SCENARIO + _LAYOUT + _YAML),
        Target("camera", 128, 1, _HEADERS),
        Target("layout_file", 256, 2, _LAYOUT + _YAML + _LAYOUT_FILE, shares="texts"),
        Target("address", 96, 22, _ADDRESS, shares="texts"),
        Target("spec", 128, 22, _SPEC + _LAYOUT, shares="texts"),
        Target("cell_file", 512, 2, _CELL + _YAML, shares="tests.inspection.fuzz_cells"),
        Target("gs1", 96, 22, _GS1, shares="tests.inspection.fuzz_cells"),
        Target("program_result", 160, 6, _NUMBERS, shares="tests.inspection.fuzz_cells"),
    )
}
"""Every target by name, in the order in which they run."""


class Known(NamedTuple):
    """One finding.

    Attributes:
        name: of its input, which begins the name that it has among the findings.
        target: where it was found.
        pattern: regular expression for what :func:`describe` says of it.
        about: what is wrong.
    """

    name: str
    target: str
    pattern: str
    about: str


KNOWN = (
    Known(
        "unknown-key-is-a-surrogate",
        "scenario",
        r"UnicodeEncodeError: .*surrogates not allowed in main\.py:model_validate",
        "an error's text has a lone surrogate in it, which pydantic cannot take",
    ),
    Known(
        "memory-for-slots",
        "scenario",
        r"AssertionError: too much memory",
        "slots are filled with zeros before the container's size is looked at",
    ),
    Known(
        "memory-for-an-errors-text",
        "scenario",
        r"AssertionError: too much memory",
        "a wrong value is written out in full before 64 characters of it are taken",
    ),
)


def describe(error: BaseException) -> str:
    """Return what was raised and where, in one line."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    text = str(error).replace("\n", " ")
    return f"{type(error).__name__}: {text} in {Path(last.filename).name}:{last.name}"


def known(target: str, error: BaseException) -> Known | None:
    """Return the row that a finding belongs to, None for a new one."""
    said = describe(error)
    rows = (one for one in KNOWN if one.target == target)
    return next((one for one in rows if re.match(one.pattern, said)), None)
