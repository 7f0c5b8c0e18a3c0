"""The documents: their examples run, their tables are complete, every page is in the contents.

``python`` blocks run as scripts of their own. ``console`` blocks run line by line, each block with
an emulator of its own unless it starts one, or an agent of a fleet; what they show must be what is
printed, numbers aside.
A block of any language whose first line is ``# NAME.EXTENSION`` is a file, which the page's
``console`` blocks find in their folder.
"""

from __future__ import annotations

import contextlib
import importlib.util
import inspect
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from smartcam import exceptions
from smartcam.camera import Camera
from smartcam.depth import region_depth
from smartcam.emulator import InSightQuirks, Quirks, faults
from smartcam.frames import FrameSource
from smartcam.models import Statistics, Status
from smartcam.protocols import BVS, FramedDialect, State
from smartcam.protocols._inside import HANDBOOK
from smartcam.settings import CameraSettings, known_protocols
from tests import ROOT
from tests.machines import B16, BID, CODES, TRANSITIONS
from tests.processes import MAINS, Process

pytestmark = pytest.mark.long

DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
CAMERA = "bvs://192.168.0.10"
"""The address of a real camera in examples; an emulator's takes its place here."""
LOCAL = re.compile(r"127\.0\.0\.1:\d{4,5}")

OPTIONAL = ("opentelemetry.sdk", "prometheus_client")
"""Packages that some examples import and the tests do not demand; the extra ``dev`` has them."""


class Block(NamedTuple):
    """A fenced block of a page; ``line`` is that of its first line."""

    page: Path
    line: int
    text: str


def blocks(language: str, pages: list[Path]) -> list[Any]:
    """Return the blocks of one language as test parameters."""
    fence = re.compile(rf"^```{language}\n(.*?)^```$", re.DOTALL | re.MULTILINE)
    found = [
        Block(page, text[: match.start(1)].count("\n") + 1, match[1])
        for page in pages
        for text in [page.read_text(encoding="utf-8")]
        for match in fence.finditer(text)
    ]
    return [
        pytest.param(block, id=f"{block.page.relative_to(ROOT)}:{block.line}") for block in found
    ]


FILE = re.compile(
    r"^```(?:python|yaml|ini|toml)\n# ([\w-]+\.\w+)\n(.*?)^```$", re.DOTALL | re.MULTILINE
)


def files(page: Path) -> dict[str, str]:
    """Return the files that a page shows."""
    return dict(FILE.findall(page.read_text(encoding="utf-8")))


# ---------------------------------------------------------------------- running

MODULES = {"pytest": "pytest"}


class Shell:
    """Runs the lines of a console block as a reader would type them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.address = ""  # host and port of the emulator last started
        self._running = contextlib.ExitStack()

    def start(self, arguments: list[str]) -> Process:
        """Start a command; what needs an emulator gets the present one's address."""
        if not stays(arguments) and any(map(LOCAL.search, arguments)):
            if not self.address:
                self.emulate(["smartcam-emulator"], 1)
            arguments = [LOCAL.sub(self.address, one) for one in arguments]
        program, *rest = arguments
        if program in MODULES:
            arguments = [sys.executable, "-m", MODULES[program], *rest]
        process = Process(
            *arguments,
            cwd=self.folder,
            merged=True,
            # how this run of pytest was called says nothing to one on a page
            env={"PYTHONUNBUFFERED": "1", "PYTEST_ADDOPTS": ""},
            fresh=program not in MAINS,
        )
        process.close_stdin()
        return self._running.enter_context(process)

    def emulate(self, arguments: list[str], cameras: int) -> str:
        """Start an emulator, or an agent, on a free port; return a first line for each camera."""
        free = ["0" if before == "--port" else one for before, one in pairs(arguments)]
        for one in self.folder.glob("*.yaml"):  # an agent listens where its file says
            text = one.read_text(encoding="utf-8")
            one.write_text(LOCAL.sub("127.0.0.1:0", text), encoding="utf-8")
        process = self.start(free)
        printed = process.read_until(b"\n", count=cameras)
        address = LOCAL.search(printed)
        assert address is not None, printed
        self.address = address[0]
        return printed

    def run(self, arguments: list[str], shown: list[str]) -> tuple[str, int]:
        """Run a command to its end, or to the Ctrl-C that is shown; return output and code."""
        process = self.start(arguments)
        if "^C" in shown:
            process.read_until(b"\n", count=shown.index("^C"))
            process.send_signal(signal.SIGINT)
        ended = process.wait()
        return ended.out, ended.code

    def end(self) -> None:
        """End what still runs."""
        self._running.close()


def stays(arguments: list[str]) -> bool:
    """Return whether a command runs as long as the commands below it."""
    return arguments[0] == "smartcam-emulator" or arguments[:2] == ["smartcam", "serve"]


def pairs(arguments: list[str]) -> list[tuple[str, str]]:
    return list(zip(["", *arguments], arguments, strict=False))


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[Shell]:
    shell = Shell(tmp_path)
    yield shell
    shell.end()


def steps(text: str, line: int) -> Iterator[tuple[int, str, list[str]]]:
    """Yield each command of a console block with its line and the lines shown below it."""
    for part in re.split(r"^(?=\$ )", text, flags=re.MULTILINE):
        if part.startswith("$ "):
            command, *shown = part.replace("\\\n", " ").splitlines()
            yield line, command[2:], [one for one in shown if one.strip()]
        line += part.count("\n")


def shape(text: str) -> str:
    """Return a line without its numbers, times and widths."""
    return " ".join(re.sub(r"-?\b\d[\w.:+-]*", "#", text).split())


def missing_line(shown: list[str], printed: str) -> str | None:
    """Return the first line shown that was not printed, in this order; ``...`` cuts a line."""
    actual = iter([shape(one) for one in printed.splitlines()])
    for one in shown:
        wanted = shape(one)
        if wanted not in {"...", "^C"} and not any(
            line.startswith(wanted[:-4]) if wanted.endswith(" ...") else line == wanted
            for line in actual
        ):
            return one
    return None


# ---------------------------------------------------------------------- examples


@pytest.mark.parametrize("block", blocks("python", PAGES))
def test_python_block_runs(block: Block, shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    text = block.text
    if re.match(r"# ([\w-]+\.py)\n", text):
        compile(text, str(block.page), "exec", dont_inherit=True)
        return  # a file, which a console block runs
    for name in OPTIONAL:
        if f"from {name}" in text:
            pytest.importorskip(name, reason=f"needs {name}, of the extra dev")
    if CAMERA in text:
        text = text.replace(CAMERA, shell.emulate(["smartcam-emulator"], 1).strip())
    shown = files(block.page)
    if any(name in text for name in shown):
        for name, content in shown.items():  # an agent listens where its file says
            path, port = shell.folder / name, "listen: tcp/127.0.0.1:0"
            path.write_text(re.sub(r"listen: \w+/\S+:\d+", port, content), encoding="utf-8")
        monkeypatch.chdir(shell.folder)
    # empty lines in front, so that a traceback names the page's own lines
    code = compile("\n" * (block.line - 1) + text, str(block.page), "exec", dont_inherit=True)
    exec(code, {"__name__": "__main__"})  # noqa: S102 - what stands in our own documents


@pytest.mark.skipif(sys.platform == "win32", reason="a POSIX shell's examples")
@pytest.mark.parametrize("block", blocks("console", PAGES))
def test_console_block_runs(block: Block, shell: Shell) -> None:
    for name, text in files(block.page).items():
        (shell.folder / name).write_text(text, encoding="utf-8")
    todo = list(steps(block.text, block.line))
    for (line, command, shown), (_, following, code) in zip(
        todo, [*todo[1:], (0, "", [])], strict=True
    ):
        arguments = shlex.split(command)
        where = f"{block.page}:{line}: $ {command}\n"
        ends = {"^C", "--help", "--schema", "echo $?"}.intersection([*shown, *arguments, following])
        if stays(arguments) and not ends:
            printed, ended = shell.emulate(arguments, len(shown) or 1), 0
        elif arguments[0] in {*MAINS, *MODULES, "cat", "head", "tail"}:
            printed, ended = shell.run(arguments, shown)
        else:
            continue
        wanted = int(code[0]) if following == "echo $?" else 0
        assert ended == wanted, f"{where}exit code {ended}, not {wanted}:\n{printed}"
        missing = missing_line(shown, printed)
        assert missing is None, f"{where}shown but not printed: {missing}\n{printed}"


def test_what_sh_blocks_name_is_there() -> None:
    texts = [block.values[0].text for block in blocks("sh", PAGES)]
    named = {
        word
        for text in texts
        for word in shlex.split(text, comments=True)
        if re.fullmatch(r"(tests|examples|docs|smartcam|benchmarks|\.ci)/[\w./-]+", word)
    }
    assert len(named) > 5
    assert [word for word in sorted(named) if not (ROOT / word).exists()] == []


# ---------------------------------------------------------------------- contents


def test_file_that_a_page_shows_is_run_by_a_command_of_it() -> None:
    for page in PAGES:
        shown = files(page)
        users = [
            block.values[0].text
            for language in ("console", "python")
            for block in blocks(language, [page])
        ]
        users += shown.values()
        unused = [name for name in shown if not any(Path(name).stem in text for text in users)]
        assert unused == []


def test_every_page_is_in_the_contents() -> None:
    pages = set(DOCS.rglob("*.md"))
    named = {DOCS / "index.md"}
    for page in pages:
        text = page.read_text(encoding="utf-8")
        for tree in re.findall(r"^```\{toctree\}\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
            entries = re.findall(r"^([a-z0-9./-]+)$", tree, re.MULTILINE)
            named |= {(page.parent / f"{entry}.md").resolve() for entry in entries}
    assert named == pages


def test_every_page_the_readme_names_is_there() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    targets = re.findall(r"\]\(([^):]+?)(?:#[^)]*)?\)", text)
    assert [target for target in targets if not (ROOT / target).exists()] == []


@pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("sphinx", "myst_parser", "furo")),
    reason="needs the extra docs",
)
def test_documents_build_without_warnings(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "dummy"]
    done = subprocess.run(  # noqa: S603
        [*build, "-d", str(tmp_path / "cache"), str(DOCS), str(tmp_path / "html")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_reference_tells_the_fields_of_a_returned_class_that_no_module_exports() -> None:
    lines = ["Return the depth of a region."]
    module_of("conf")._tell_returned(None, "function", "", region_depth, None, lines)
    assert "``RegionDepth``: The depth of a region, and its standard deviations." in lines
    assert any(line.startswith("    sigma: standard deviation of ``median``") for line in lines)


def test_reference_tells_the_methods_of_a_returned_class_that_no_module_exports() -> None:
    lines = ["The features."]
    module_of("conf")._tell_returned(None, "property", "", FrameSource.features, None, lines)
    assert any(line.startswith("- ``names(*, timeout: float") for line in lines)
    assert "``FrameFeature``: One feature of a source's device. Made by" in " ".join(lines)
    assert any(line.startswith("- ``set(value: FeatureValue, *, timeout:") for line in lines)


def test_reference_tells_a_field_s_class_that_no_module_exports() -> None:
    lines = ["The account."]
    module_of("conf")._tell_returned(None, "class", "", Statistics, None, lines)
    assert "``Histogram``: A histogram of durations." in lines


# ---------------------------------------------------------------------- promises, troubleshooting


def test_troubleshooting_has_every_error() -> None:
    page = (DOCS / "troubleshooting.md").read_text(encoding="utf-8")
    shown = re.findall(r"^#### `(\w+)`$", page, re.MULTILINE)
    families = {"SmartCamError", "LinkError", "TriggerError", "ProtocolError"}
    errors = [name for name in exceptions.__all__ if name.endswith("Error")]
    assert sorted([*shown, *families]) == sorted(errors)


def test_promises_name_tests_that_are_there() -> None:
    page = (ROOT / "results" / "promises.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`(tests/[\w/.]*)`", page))
    assert len(named) > 20
    assert [name for name in sorted(named) if not (ROOT / name).exists()] == []


def test_promises_have_every_wait_with_its_default() -> None:
    page = (DOCS / "promises.md").read_text(encoding="utf-8")
    table = page.partition("\n(waits)=\n")[2].partition("\nThe `timeout` includes")[0]
    waits = [row for row in rows(table[table.index("\n|") + 1 :]) if len(row) == 3]
    named: set[str] = set()
    calls = [(call, *row) for calls, *row in waits for call in re.findall(r"\w+\([\w=]*\)", calls)]
    for call, bound, default in calls:
        name = call.partition("(")[0]
        method = inspect.signature(getattr(Camera, name))
        options = re.findall(r"\b(\w*timeout)\b(?!=)", bound)
        seconds = [
            method.parameters[option].default
            if option in method.parameters
            else getattr(CameraSettings, option)
            for option in options
        ]
        assert default == ", ".join(f"{one:g} s" for one in seconds), call
        named.add(name)
    waiting = {
        name
        for name, member in vars(Camera).items()
        if inspect.iscoroutinefunction(member) and not name.startswith("_")
    }
    assert named == waiting | {"application", "next_result", "reserve"}  # no coroutine functions


# ---------------------------------------------------------------------- tables


@pytest.fixture(scope="module")
def tables() -> dict[str, str]:
    """Return every table that the documents make from the code."""
    return {name: make() for name, make in module_of("conf").GENERATED.items()}


def module_of(name: str) -> Any:
    """Return a module from the folder of the documents."""
    spec = importlib.util.spec_from_file_location(f"docs_{name}", DOCS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def rows(table: str) -> list[list[str]]:
    lines = [line.strip("|").split("|") for line in table.splitlines()[2:]]
    return [[cell.strip(" `") for cell in line] for line in lines]


each_table = pytest.mark.parametrize(
    ("suffix", "dialect"), [("", HANDBOOK), ("_b16", B16), ("_bid", BID)]
)


@each_table
def test_message_table_has_every_message(
    tables: dict[str, str], suffix: str, dialect: FramedDialect
) -> None:
    table = rows(tables["messages" + suffix])
    shown = [(int(row[0], 16), row[2], f"{row[5]}, {row[6]}") for row in table]
    assert shown == [(row.message_id, row.type.__name__, row.source) for row in dialect.table]
    assert {row[6] for row in table} <= {"published", "derived", "inferred"}


@each_table
def test_body_table_has_every_field_at_its_offset(
    tables: dict[str, str], suffix: str, dialect: FramedDialect
) -> None:
    table = rows(tables["bodies" + suffix])
    names = [row[3] for row in table]
    assert names == [
        name for row in dialect.table for name in [f for f, _ in row.fields] or ["none"]
    ]
    seconds = [row[2] for row in table if row[3] == "second"]
    assert seconds == {"": ["32", "32"], "_b16": ["14", "14"], "_bid": ["16", "14"]}[suffix]


def test_tables_of_the_dialects_have_all_of_them(tables: dict[str, str]) -> None:
    shown = [(row[0], row[1]) for row in rows(tables["dialects"])]
    known = [(one.name, name) for one in known_protocols() for name in one.dialects]
    assert sorted(shown) == sorted(known)
    assert [name for make, name in shown if make == "bvs"] == list(BVS.dialects)
    yes = {row[0] for row in rows(tables["abilities"]) if row[4] == "yes"}
    assert yes == set(BID.capabilities.names)
    assert [int(row[0], 16) for row in rows(tables["result_codes"])] == list(CODES)
    assert len(rows(tables["wire_quirks"])) == len(B16.wire_quirks)


def test_quirk_table_has_every_quirk(tables: dict[str, str]) -> None:
    shown = {row[0]: row[3] for row in rows(tables["quirks"])}
    assert shown == {name: field.description for name, field in Quirks.model_fields.items()}
    assert [row[0] for row in rows(tables["quirks_insight"])] == list(InSightQuirks.model_fields)


def test_fault_tables_have_every_fault_with_its_fields(tables: dict[str, str]) -> None:
    shown = [*rows(tables["faults_wire"]), *rows(tables["faults_device"])]
    assert [row[0].removesuffix("` *") for row in shown] == list(faults.FAULTS)
    assert [row for row in shown if not row[1]] == []
    shared = {row[0] for row in rows(tables["faults_which"])} | {"kind", "when"}
    for row, made in zip(shown, faults.FAULTS.values(), strict=True):
        own = set(made.model_fields) - shared
        assert set(re.findall(r"(?:^|>)`?(\w+)`:", row[2])) == own


def test_tables_of_scenarios_say_what_each_field_is(tables: dict[str, str]) -> None:
    for name in ("application", "scenario", "cue"):
        assert [row[0] for row in rows(tables[name]) if not row[1]] == []


def test_session_diagram_has_every_transition(tables: dict[str, str]) -> None:
    text = tables["transitions"]
    for (state, _, message), following in TRANSITIONS.items():
        assert f"\n{state.name} --> {following.name}\n" in text
        assert re.search(rf"\b{message.__name__}\b", text)
    assert all(state.name in text for state in State)


def test_limits_table_says_why(tables: dict[str, str]) -> None:
    without = [row[0] for row in rows(tables["limits"]) if not row[2]]
    assert without == []


def test_architecture_names_every_module() -> None:
    page = (DOCS / "architecture" / "rooms.md").read_text(encoding="utf-8")
    modules = [path.stem for path in (ROOT / "smartcam").iterdir() if not path.name.startswith("_")]
    named = {
        name for row in re.findall(r"^\| (`.+?) \|", page, re.MULTILINE) for name in row.split(", ")
    }
    assert [name for name in modules if name != "py" and f"`{name}`" not in named] == []


def test_table_of_modules_says_what_each_one_holds(tables: dict[str, str]) -> None:
    said = rows(tables["modules"])
    assert len(said) == len([*(ROOT / "smartcam").rglob("*.py")])
    assert [row[:2] for row in said if not row[2]] == []


def test_drawing_of_the_rooms_is_what_the_imports_say() -> None:
    rooms = module_of("rooms")
    drawn = rooms.DRAWING.read_text(encoding="utf-8")
    assert drawn == rooms.drawing(), "python docs/rooms.py draws it anew"


def test_import_contract_is_shown(tables: dict[str, str]) -> None:
    assert "protocols" in tables["layers"]
    assert "camera | TCP" in tables["policies"]


def test_protocol_page_has_every_status_bit() -> None:
    page = (DOCS / "protocol.md").read_text(encoding="utf-8")
    table = [bit for bit in Status if bit.value < 1 << 32]
    assert [bit for bit in table if f"| `{bit.value:#05x}` | `{bit.name}` |" not in page] == []
    bid = page.partition("### `bid`")[2].partition("\n## ")[0]
    assert {bit.name for bit in Status if f"| `{bit.name}` |" in bid} == {
        "OVERTRIGGERED", "SIMULATION_MODE", "WAITING_FOR_TRIGGER"
    }  # fmt: skip


def test_every_generated_table_is_in_a_page(tables: dict[str, str]) -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in DOCS.rglob("*.md"))
    assert set(re.findall(r"^```\{generated\} (\w+)$", text, re.MULTILINE)) == set(tables)
