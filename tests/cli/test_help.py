"""Help that can be guessed: lists with whole summaries, words that were meant, completion."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.commandline import run
from tests.processes import Outcome, Process


def folded(text: str) -> str:
    """Return a text on one line."""
    return " ".join(text.split())


def assert_wrong_use(outcome: Outcome, text: str) -> None:
    """See that a command ended by a usage error with a text."""
    assert (outcome.code, text in folded(outcome.err)) == (2, True), outcome.err


def test_help_names_the_emulator() -> None:
    out = run("--help").done().out
    assert "\n  emulator " in out
    assert '"smartcam emulator"' in folded(out)


@pytest.mark.parametrize("name", ["emulator", "emulate"])
def test_emulator_is_a_command_of_smartcam_too(name: str) -> None:
    with Process("smartcam", name, "--dialect", "thesis") as emulator:
        assert "?dialect=thesis" in emulator.read_until(b"\n")
        emulator.send_signal(15)
        emulator.wait().done()


def test_calibrate_lists_its_parts_and_hides_what_it_does_itself() -> None:
    listed = run("calibrate", "--help").done().out.partition("Commands:\n")[2]
    assert [line.split()[0] for line in listed.splitlines() if line[2:3].strip()] == [
        "compare",
        "draw",
        "lens",
    ]


def test_timeout_of_probe_says_what_it_does() -> None:
    assert "Longest time of all attempts together" in run("probe", "--help").done().out


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (("emulat",), "No such command 'emulat'; did you mean 'emulator'?"),
        (("fleet", "watc"), "No such command 'watc'; did you mean 'watch'?"),
        (("status", "bvs://h", "--time-out", "3"), "'--time-out'; did you mean '--timeout'?"),
        (("trigger", "bvs://h", "--interpret", "raw"), "did you mean '--interpret-as'?"),
        (("status", "bvs://h", "--colour"), "No such option '--colour'."),
    ],
)
def test_unknown_word_is_told_which_one_was_meant(arguments: tuple[str, ...], meant: str) -> None:
    assert_wrong_use(run(*arguments), meant)


@pytest.mark.parametrize(
    "command", [("serve",), ("ros2",), ("ros1", "--bridge", "ws://h"), ("fleet", "list")]
)
def test_address_of_a_camera_is_no_fleet(command: tuple[str, ...]) -> None:
    outcome = run(*command, "bvs://192.168.0.10")
    outcome.failed(2, "expected", "fleet", "bvs://192.168.0.10")
    assert "Errno" not in outcome.err


def test_fleet_that_is_served_already_is_no_fleet_file() -> None:
    run("serve", "fleet://h").failed(2, "expected a fleet file", "serves that fleet already")


# ---------------------------------------------------------------------- completion


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("ZDOTDIR", "XDG_CONFIG_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("SHELL", "/usr/bin/zsh")
    return tmp_path


@pytest.mark.parametrize(
    ("shell", "file"),
    [("", ".zshrc"), ("bash", ".bashrc"), ("fish", ".config/fish/conf.d/smartcam.fish")],
)
def test_completion_is_written_once_after_what_is_there(home: Path, shell: str, file: str) -> None:
    path = home / file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("# mine")
    assert file in run("--install-completion", *filter(None, [shell])).done().out
    first, *lines = path.read_text().splitlines()
    assert first == "# mine"
    assert len(lines) == 2
    assert "_SMARTCAM_COMPLETE=" in lines[0]
    assert "_SMARTCAM_EMULATOR_COMPLETE=" in lines[1]
    assert "already" in run("--install-completion", *filter(None, [shell])).done().out
    assert path.read_text().splitlines() == [first, *lines]


def test_completion_of_an_unknown_shell_is_refused(home: Path) -> None:
    outcome = run("--install-completion", "fsh")
    assert_wrong_use(outcome, "expected one of bash, zsh, fish, got 'fsh'; did you mean 'fish'?")
    assert not [*home.iterdir()]
