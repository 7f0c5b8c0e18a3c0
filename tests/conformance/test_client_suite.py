"""The suite for clients as their authors run it: in a pytest of its own."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple, cast

import pytest

from smartcam.conformance.client._suite import ClientOptions, read_options

ROOT = Path(__file__).parents[2]
SECONDS = 300
WITHOUT = ("-p", "no:asyncio", "-p", "no:anyio", "-p", "no:cacheprovider")
"""The suite needs no plugin."""

OWN = '''
from tests.conformance.plain_client import plain_client
from smartcam.conformance.client import ClientConformance


class TestSinner(ClientConformance):
    """Sends a request that no camera knows, and knows no message that is new."""

    def perform(self, task):
        return plain_client("unknown request", "knows all", seconds=60)(task)


class TestLazy(ClientConformance):
    dialects = ("b16",)

    async def perform(self, task):
        raise NotImplementedError(f"{task.dialect} over {task.transport}")


class TestNobody(ClientConformance):
    """Says nothing of its client."""


class TestMissing(ClientConformance):
    command = ["./no-such-client", "{url}", "{task}"]
    dialects = ("handbook", "bid")
    transports = ("udp",)
'''


class Ended(NamedTuple):
    """The end of a run of pytest."""

    code: int
    out: str

    def outcome(self, test: str) -> str:
        """Return the outcome of a test."""
        found = re.search(rf"{re.escape(test)}\] (\w+)", self.out)
        assert found is not None, self.out
        return found[1]


def run_pytest(folder: Path, *arguments: str) -> Ended:
    """ClientRun a pytest without this project's settings."""
    (folder / "pytest.ini").write_text("[pytest]\nfilterwarnings = error\n", encoding="ascii")
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-m", "pytest", "-v", "-rs", *WITHOUT, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "400", "PYTEST_ADDOPTS": ""},
        capture_output=True,
        text=True,
        check=False,
        timeout=SECONDS,
    )
    return Ended(done.returncode, done.stdout + done.stderr)


@pytest.mark.long
def test_suite_in_somebodys_own_tests(tmp_path: Path) -> None:
    (tmp_path / "test_mine.py").write_text(OWN, encoding="utf-8")
    few = "triggers or sends_whole_messages or unknown_messages"
    own = run_pytest(tmp_path, "-k", f"({few}) and not times and not often and not switch")
    it_fails_what_must_be_and_shows_the_wire(own)
    it_passes_what_only_should_be_and_reports_it(own)
    it_skips_what_the_client_cannot_do(own)
    without_a_client_it_says_what_to_type(own)
    with_a_command_that_is_not_there_it_fails_with_its_name(own)


def it_fails_what_must_be_and_shows_the_wire(own: Ended) -> None:
    assert own.code == 1
    test = "TestSinner::test_client[handbook-tcp-sends_whole_messages"
    assert own.outcome(test) == "FAILED"
    assert "sends_whole_messages (must; handbook, tcp): the camera ignores 50 53 56 42" in own.out
    assert "  source: SC-A28, MV25, published (docs/sources.md)" in own.out
    assert "> ?  50 53 56 42 00 00 00 00 99 00 00 00" in own.out


def it_passes_what_only_should_be_and_reports_it(own: Ended) -> None:
    test = "TestSinner::test_client[handbook-tcp-passes_over_unknown_messages"
    assert own.outcome(test) == "PASSED"
    section = own.out.partition("smartcam: the client")[2]
    assert "\nmust: 1\nsends_whole_messages (handbook, tcp): the camera ignores" in section
    assert "\nshould: 1\npasses_over_unknown_messages (should; handbook, tcp): it" in section
    assert "  because: a later firmware may have more messages" in section


def it_skips_what_the_client_cannot_do(own: Ended) -> None:
    assert own.outcome("TestLazy::test_client[b16-tcp-triggers") == "SKIPPED"
    assert 'the client cannot do the task "trigger": b16 over tcp' in own.out


def without_a_client_it_says_what_to_type(own: Ended) -> None:
    assert own.outcome("TestNobody::test_client[handbook-tcp-triggers") == "SKIPPED"
    assert (
        'no client: pytest --pyargs smartcam.conformance.client --client-command "./mine {host} '
        '{port} {task}"'
    ) in own.out


def with_a_command_that_is_not_there_it_fails_with_its_name(own: Ended) -> None:
    for dialect in ("handbook", "bid"):
        assert own.outcome(f"TestMissing::test_client[{dialect}-udp-triggers") == "FAILED"
    assert "client command './no-such-client': No such file or directory" in own.out


@pytest.mark.long
def test_suite_from_the_shell_judges_a_command(tmp_path: Path) -> None:
    example = ROOT / "tests" / "conformance" / "plain_client.py"
    client = f"{sys.executable} -S {example} {{host}} {{port}} cannot-watch {{task}}"
    ended = run_pytest(
        tmp_path,
        *("--pyargs", "smartcam.conformance.client", "--client-command", client),
        *("-k", "switches or watches", "--client-timeout", "200", "--client-dialect", "handbook"),
    )
    assert ended.code == 0, ended.out
    assert ended.outcome("test_client[handbook-tcp-switches") == "PASSED"
    assert ended.outcome("test_client[handbook-tcp-watches") == "PASSED"
    assert "smartcam: the client" not in ended.out


class Given:
    """A configuration with some options."""

    def __init__(self, **options: object) -> None:
        self._options = options

    def getoption(self, name: str, default: object) -> object:
        return self._options.get(name.removeprefix("--client-"), default)


def test_options_are_read_and_none_is_needed() -> None:
    given: Any = Given(command="./mine {url} {task}", dialect="b16, bid", timeout=5)
    options = read_options(given)
    assert options == ClientOptions("./mine {url} {task}", ("b16", "bid"), None, 5.0)
    assert read_options(cast("Any", Given())) == ClientOptions()


@pytest.mark.parametrize(
    ("option", "value", "text"),
    [
        ("dialect", "b16,b17", "--client-dialect: 'b17'; known are handbook, thesis, b16, bid"),
        ("transport", "serial", "--client-transport: 'serial'; known are tcp, udp"),
        ("timeout", -1.0, "--client-timeout: -1 s; more than 0 and at most 3600 s are expected"),
    ],
)
def test_options_that_cannot_be_are_wrong_usage(option: str, value: object, text: str) -> None:
    given: Any = Given(**{option: value})
    with pytest.raises(pytest.UsageError) as caught:
        read_options(given)
    assert str(caught.value) == text


def test_options_for_the_plugin_import_nothing_heavy() -> None:
    code = (
        "import sys; from smartcam.conformance._pytest_options import add_options; "
        "print(sorted({'asyncio', 'numpy', 'pydantic', 'pytest', 'smartcam.emulator'} "
        "& set(sys.modules)))"
    )
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
