"""Commands that need no camera: lists, help, the demo, and errors without the extra."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import TYPE_CHECKING

import click
import pytest
from click.testing import CliRunner

import smartcam
from smartcam._cli.dissector import dissector
from smartcam._cli.smartcam import LISTED, TOPICS
from smartcam._cli.smartcam import command as smartcam_command
from smartcam._cli.smartcam_emulator import PROTOCOL
from smartcam._dissector import lua_source
from smartcam.protocols import BVS
from smartcam.registry import INTERPRETERS, PROTOCOLS
from tests.cli.commandline import each, run, run_emulator
from tests.cli.inside import DIALECTS
from tests.processes import Process, printed_by

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from click.testing import Result

CONNECTING = ("probe", "status", "trigger", "watch", "switch", "start", "stop")
OTHERS = ("decode", "protocols", "interpreters", "demo")


def test_protocols_lists_dialects_and_transports() -> None:
    out = run("protocols").done().out
    for text in ("bvs (built-in)", "bvs://", "bvs+udp://", "36701", "BVS002C", "thesis"):
        assert text in out


def test_module_is_the_command() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "smartcam", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout == run("--version").done().out


def test_protocols_json_has_one_object_for_each() -> None:
    (bvs,) = [one for one in run("protocols", "--json").done().lines if one["name"] == "bvs"]
    assert (bvs["default_port"], bvs["schemes"]) == (36701, ["bvs", "bvs+udp"])
    assert [one["name"] for one in bvs["dialects"]][:2] == ["handbook", "thesis"]
    assert all(one["about"] and one["source"] for one in bvs["dialects"])


def test_interpreters_lists_the_built_in_ones() -> None:
    names = {"localizations", "raw", "record", "strings50", "table"}
    lines = run("interpreters", "--json").done().lines
    assert {line["name"] for line in lines if line["origin"] == "built-in"} == names
    assert all(line["about"] for line in lines if line["name"] in names)
    out = run("interpreters").done().out
    assert {line.split()[0] for line in out.splitlines()} >= names
    assert "one Localization for each found part" in out


def test_help_lists_every_command_by_topic() -> None:
    listed = [name for names in TOPICS.values() for name in names]
    assert sorted(listed) == sorted(smartcam_command.commands)
    out = run("--help").done().out
    assert [out.index(f"\n{topic}:\n") for topic in TOPICS] == sorted(
        out.index(f"\n{topic}:\n") for topic in TOPICS
    )
    assert "..." not in out.partition("A camera:")[2]


def test_list_has_the_first_sentence_of_each_commands_help() -> None:
    for name, listed in LISTED.items():
        with each(name):
            command = smartcam_command.commands[name]
            assert command.name == name
            assert listed.summary == command.get_short_help_str(limit=400)


def test_every_group_lists_its_commands_with_whole_summaries() -> None:
    for name in ("fleet", "frames", "depth", "sheet", "calibrate"):
        with each(name):
            group = smartcam_command.commands[name]
            assert isinstance(group, click.Group)
            out = run(name, "--help").done().out.partition("Commands:\n")[2]
            listed = " ".join(out.split())
            shown = {key: one for key, one in group.commands.items() if not one.hidden}
            assert shown
            for key, one in shown.items():
                assert f"{key} {one.get_short_help_str(400)}" in listed
            assert "..." not in listed


def test_dialects_of_options_are_those_of_the_protocol() -> None:
    assert tuple(BVS.dialects) == DIALECTS
    assert BVS.name == PROTOCOL


def imported_for(python: str) -> set[str]:
    """Return the imports of lines of Python in a new process; ``main`` runs without an end."""
    run_main = "def main(run):\n    try: run()\n    except SystemExit: pass\n"
    told = "print('imported:', *sorted(sys.modules))"
    shown = printed_by(f"import sys, smartcam._cli as cli\n{run_main}{python}\n{told}")
    return set(shown.rpartition("imported:")[2].split())


HEAVY = {"asyncio", "construct", "logging", "numpy", "pydantic", "socket", "yaml"}


@pytest.mark.parametrize(
    ("main", "argument"), [("main", "--help"), ("main", "--version"), ("emulator_main", "--help")]
)
def test_help_imports_what_it_shows_and_nothing_else(main: str, argument: str) -> None:
    found = imported_for(f"sys.argv = ['smartcam', {argument!r}]\nmain(cli.{main})")
    assert "click" in found
    assert not found & HEAVY
    own = {name for name in found if name.startswith("smartcam.")}
    assert {name.split(".")[1] for name in own} <= {"_cli", "_extras", "_lazy", "exceptions"}


HELPS = """
import io, contextlib, click
from smartcam._cli.smartcam import command
def commands(group, *names):
    yield names
    for name in group.list_commands(None) if isinstance(group, click.Group) else ():
        yield from commands(group.get_command(None, name), *names, name)
for names in commands(command):
    with contextlib.redirect_stdout(io.StringIO()) as out:
        sys.argv = ["smartcam", *names, "--help"]
        main(cli.main)
    assert out.getvalue().startswith(" ".join(["Usage: smartcam", *names[:1]])), names
    print(*names)
"""
"""Every command's help, those of groups too, in one process."""


def test_help_of_a_command_imports_no_room() -> None:
    found = imported_for(HELPS)
    assert not found & (HEAVY - {"asyncio", "logging", "socket"})
    own = {name for name in found if name.startswith("smartcam.")}
    assert own >= {f"smartcam._cli.{listed.module}" for listed in LISTED.values()}
    light = {"_arguments", "_cli", "_extras", "_lazy", "backoff", "exceptions", "models"}
    assert {name.split(".")[1] for name in own} <= light


@pytest.mark.long
def test_completion_knows_commands_and_options() -> None:
    for words, cword, wanted in (
        ("smartcam do", 1, "doctor"),
        ("smartcam watch --sec", 2, "--sec"),
    ):
        told = subprocess.run(
            [sys.executable, "-m", "smartcam"],
            capture_output=True,
            text=True,
            check=False,
            env={
                **os.environ,
                "_SMARTCAM_COMPLETE": "bash_complete",
                "COMP_WORDS": words,
                "COMP_CWORD": str(cword),
            },
        )
        assert wanted in told.stdout


@pytest.fixture
def broken_plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Install plug-ins that end the program, or are none."""
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "hurt_module.py").write_text("import sys\nsys.exit(3)\n")
    (tmp_path / "dull_module.py").write_text("f = 5\n")
    for name in ("hurt", "dull"):
        info = tmp_path / f"{name}-0.1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n")
        points = f"{name} = {name}_module:f\n"
        (info / "entry_points.txt").write_text(
            f"[smartcam.interpreters]\n{points}[smartcam.protocols]\n{points}"
        )
    for registry in (PROTOCOLS, INTERPRETERS):
        registry.refresh()
    yield
    for registry in (PROTOCOLS, INTERPRETERS):
        registry.refresh()
    sys.modules.pop("dull_module", None)


@pytest.mark.usefixtures("broken_plugins")
@pytest.mark.parametrize(("command", "good"), [("protocols", "bvs"), ("interpreters", "raw")])
def test_broken_plugins_are_listed_with_their_reasons(command: str, good: str) -> None:
    lines = {one["name"]: one for one in run(command, "--json").done().lines}
    assert lines["hurt"]["error"].endswith("'hurt' of hurt failed to load: SystemExit(3)")
    assert (lines["dull"]["origin"], "5" in lines["dull"]["error"]) == ("dull", True)
    assert "error" not in lines[good]
    out = run(command).done().out
    assert "hurt  (hurt: hurt_module:f) cannot be used: smartcam." in out


@pytest.mark.long
def test_demo_tells_its_story() -> None:
    out = run("demo").done().out
    for text in ("BUSY", "7 parts", "parallelogram", "1. ", "6. Disconnected", "received 12 = "):
        assert text in out


@pytest.mark.long
def test_demo_json_is_json_with_a_balanced_account() -> None:
    lines = run("demo", "--json").done().lines
    assert [line["step"] for line in lines if "step" in line] == [1, 2, 3, 4, 5, 6]
    (result,) = [line["result"] for line in lines if "result" in line]
    assert len(result["value"]) == 7
    account = lines[-1]["statistics"]
    fates = ("triggered", "streamed", "unclaimed", "late", "wrong_application", "uninterpretable")
    assert account["received"] == sum(account[fate] for fate in fates) == 12


def test_help_of_every_command_warns_where_it_connects() -> None:
    for command in (*CONNECTING, *OTHERS):
        for option in ("--help", "-h"):
            with each(command, option):
                text = " ".join(run(command, option).done().out.split())
                assert f"Usage: smartcam {command} " in text
                warned = "Connecting takes the camera from another client" in text
                assert warned is (command in CONNECTING)


def test_help_names_every_command_and_exit_code() -> None:
    text = " ".join(run("--help").done().out.split())
    for word in (*CONNECTING, *OTHERS):
        assert f" {word} " in text
    for code in range(7):
        assert f"{code} " in text.partition("Exit codes:")[2]
    assert "Usage: smartcam-emulator " in run_emulator("--help").done().out


def test_version_is_reported() -> None:
    assert run("--version").done().out == f"smartcam, version {smartcam.__version__}\n"
    assert smartcam.__version__ in run_emulator("--version").done().out


def test_unknown_command_exits_2() -> None:
    outcome = run("dance")
    assert outcome.code == 2
    assert "No such command 'dance'" in outcome.err


@pytest.mark.parametrize("missing", ["click", "yaml"])
@pytest.mark.parametrize("program", ["smartcam", "smartcam-emulator"])
def test_command_without_the_extra_exits_2_and_names_it(
    tmp_path: Path, program: str, missing: str
) -> None:
    shim = f'raise ModuleNotFoundError("{missing}")\n'
    (tmp_path / f"{missing}.py").write_text(shim, encoding="utf-8")
    with Process(program, "--version", env={"PYTHONPATH": str(tmp_path)}, fresh=True) as process:
        outcome = process.wait()
    assert (outcome.code, outcome.out) == (2, "")
    assert outcome.err == f'{program}: needs the extra "cli": pip install "smartcam[cli]"\n'


# ---------------------------------------------------------------------- ``smartcam dissector``


def give(*options: str) -> Result:
    return CliRunner().invoke(dissector, options)


def test_dissector_is_printed() -> None:
    done = give()
    assert (done.exit_code, done.output) == (0, lua_source())


def test_dissector_is_written_to_a_file_and_nothing_is_printed(tmp_path: Path) -> None:
    path = tmp_path / "smartcam.lua"
    done = give("-o", str(path))
    assert (done.exit_code, done.output) == (0, "")
    assert path.read_text(encoding="ascii") == lua_source()


def test_dissector_that_cannot_be_written_is_a_usage_error(tmp_path: Path) -> None:
    path = tmp_path / "missing" / "smartcam.lua"
    done = give("-o", str(path))
    text = f"smartcam: error: --output {path}: No such file or directory\n"
    assert done.exit_code == 2
    assert done.output == text  # both streams, in every click
