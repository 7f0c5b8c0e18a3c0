"""Having a client do a task: as a command, as a plain function, as an asynchronous one."""

from __future__ import annotations

import asyncio
import sys
import threading

import pytest

from smartcam.conformance.client import Task
from smartcam.exceptions import ConfigurationError
from tests.argument_table import KINDS, ODD
from tests.conformance.inside import (
    SCENES,
    CommandClient,
    FunctionClient,
    Outcome,
    read_results,
    run_scene,
)
from tests.conformance.pace import at_any_pace, slowed

pytestmark = pytest.mark.real_time

TASK = Task(
    verb="switch",
    number=3,
    url="bvs://127.0.0.1:43127?dialect=b16",
    host="127.0.0.1",
    port=43127,
    transport="tcp",
    dialect="b16",
)
SHORT = 0.05


def command(code: str) -> CommandClient:
    """Return a client that is a line of Python."""
    return CommandClient([sys.executable, "-S", "-c", code, "{url}", "{task}"])


def without_time(outcome: Outcome) -> Outcome:
    return outcome._replace(seconds=0.0)


# ---------------------------------------------------------------------- the command's arguments


def test_arguments_have_the_task_as_words_and_the_address() -> None:
    client = CommandClient("./mine --at {host}:{port} -d {dialect} -t {transport} {task}")
    assert client.arguments(TASK) == [
        *("./mine", "--at", "127.0.0.1:43127", "-d", "b16", "-t", "tcp", "switch", "3")
    ]


def test_arguments_inside_others_keep_the_task_together() -> None:
    client = CommandClient(["sh", "-c", "mine {url} '{task}'", "{other}"])
    assert client.arguments(TASK) == [
        *("sh", "-c", "mine bvs://127.0.0.1:43127?dialect=b16 'switch 3'", "{other}")
    ]


@pytest.mark.parametrize("template", ["./mine {task}", "./mine {host} {port}", "./mine", ""])
def test_command_without_task_or_address_is_refused(template: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        CommandClient(template)
    assert str(caught.value) == (
        f"client command {template!r}: it needs {{task}}, and {{url}} or {{port}}"
    )


def test_command_with_an_open_quotation_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="No closing quotation"):
        CommandClient("./mine '{url} {task}")


@pytest.mark.parametrize("odd", sorted(ODD.keys() - KINDS["text"] - {"list"}))
def test_odd_command_is_refused(odd: str) -> None:
    with pytest.raises(ConfigurationError):
        CommandClient(ODD[odd])
    if odd != "None":
        with pytest.raises(ConfigurationError):
            CommandClient("x {task} {url}", cwd=ODD[odd])


@pytest.mark.parametrize("odd", sorted(ODD))
def test_odd_function_is_refused(odd: str) -> None:
    with pytest.raises(ConfigurationError):
        FunctionClient(ODD[odd])


@pytest.mark.parametrize(
    ("argument", "odd"),
    [
        (argument, odd)
        for argument, kind in [
            ("client", "object"),
            ("scene", "object"),
            ("dialect", "choice or None"),
            ("transport", "choice or None"),
            ("timeout", "seconds"),
        ]
        for odd in sorted(ODD.keys() - KINDS[kind])
    ],
)
async def test_odd_argument_of_a_run_is_refused(argument: str, odd: str) -> None:
    given = {"client": FunctionClient(lambda _: []), "scene": SCENES["trigger"]}
    with pytest.raises(ConfigurationError):
        await run_scene(**{**given, argument: ODD[odd]})


# ---------------------------------------------------------------------- what it prints


def test_lines_are_hex_or_json() -> None:
    text = b'01 02 ff\n\n{"data": "0102", "raw": "03"}\n{"raw": "04 05"}\n"06"\n  07  \n'
    assert read_results(text) == (b"\x01\x02\xff", b"\x01\x02", b"\x04\x05", b"\x06", b"\x07")


@pytest.mark.parametrize("line", [b"ok", b"{}", b'{"data": 7}', b"{", b'"', b"0", b"\xff"])
def test_line_that_is_no_result_is_reported(line: bytes) -> None:
    with pytest.raises(ValueError, match="line 2 of its output is no result: ") as caught:
        read_results(b"00\n" + line)
    assert 'expected hex, or a JSON object with "data" or "raw"' in str(caught.value)


# ---------------------------------------------------------------------- how it ends


async def test_command_that_ends_well_gives_its_results() -> None:
    code = "import sys; print('0102'); print(*sys.argv[2:], file=sys.stderr)"
    outcome = await command(code).perform(TASK, 60)
    assert without_time(outcome) == Outcome(results=(b"\x01\x02",), output="switch 3")
    assert outcome.seconds > 0


async def test_command_that_fails_has_its_exit_code_and_its_words() -> None:
    outcome = await command("import sys; print('01'); sys.exit('no camera')").perform(TASK, 60)
    assert without_time(outcome) == Outcome((b"\x01",), "exit code 1", output="no camera")


async def test_command_with_exit_code_77_cannot_do_such_a_task() -> None:
    outcome = await command("import sys; print('x'); sys.exit(77)").perform(TASK, 60)
    assert without_time(outcome) == Outcome(supported=False)


async def test_command_that_prints_nonsense_has_failed() -> None:
    outcome = await command("print('result: 7')").perform(TASK, 60)
    assert outcome.results == ()
    assert (outcome.error or "").startswith("line 1 of its output is no result: 'result: 7'")


async def test_command_that_does_not_end_is_killed_with_what_it_has_started() -> None:
    # the child holds the pipes: who waits for their end waits for it
    child = "import time; time.sleep(600)"
    code = f"import subprocess, sys; subprocess.run([sys.executable, '-S', '-c', '{child}'])"
    async with asyncio.timeout(60):
        outcome = await command(code).perform(TASK, 0.5)
    assert without_time(outcome) == Outcome(ended_in_time=False)


async def test_command_that_is_not_there_is_a_mistake_of_the_user() -> None:
    with pytest.raises(ConfigurationError) as caught:
        await CommandClient("./no-such-client {url} {task}").perform(TASK, 60)
    assert str(caught.value) == "client command './no-such-client': No such file or directory"


async def test_command_that_prints_without_end_is_read_no_further() -> None:
    code = "import sys\nfor _ in range(300): sys.stdout.write('00' * 4000 + chr(10))"
    outcome = await command(code).perform(TASK, 60)
    assert sum(len(one) for one in outcome.results) <= 1 << 20


# ---------------------------------------------------------------------- functions


async def test_function_gives_its_results_from_a_thread_of_its_own() -> None:
    threads: list[str] = []

    def perform(task: Task) -> tuple[bytes, ...]:
        threads.append(threading.current_thread().name)
        return (b"\x01", b"\x02")

    outcome = await FunctionClient(perform).perform(TASK, 60)
    assert without_time(outcome) == Outcome(results=(b"\x01", b"\x02"))
    assert threads == ["client: switch 3"]


async def test_function_that_raises_has_failed() -> None:
    def perform(task: Task) -> list[bytes]:
        raise OSError(f"no camera at {task.port}")

    outcome = await FunctionClient(perform).perform(TASK, 60)
    assert without_time(outcome) == Outcome(error="OSError: no camera at 43127")


async def test_function_that_is_not_implemented_cannot_do_such_a_task() -> None:
    async def perform(task: Task) -> list[bytes]:
        raise NotImplementedError("it only triggers")

    outcome = await FunctionClient(perform).perform(TASK, 60)
    assert without_time(outcome) == Outcome(supported=False, output="it only triggers")


async def test_function_that_does_not_end_is_left_behind() -> None:
    release = threading.Event()

    def perform(task: Task) -> list[bytes]:
        release.wait(60)
        return []

    outcome = await FunctionClient(perform).perform(TASK, SHORT)
    release.set()
    assert without_time(outcome) == Outcome(ended_in_time=False)


@at_any_pace  # it is to begin before
async def test_asynchronous_function_that_does_not_end_is_cancelled() -> None:
    ended: list[str] = []

    async def perform(task: Task) -> list[bytes]:
        try:
            await asyncio.sleep(600)
        finally:
            ended.append("cancelled")
        return []

    outcome = await FunctionClient(perform).perform(TASK, slowed(SHORT))
    assert without_time(outcome) == Outcome(ended_in_time=False)
    assert ended == ["cancelled"]
