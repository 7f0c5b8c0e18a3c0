"""Sequences: steps in order, errors, undo, repeat, abort, tokens, journals and their files."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from smartcam.calibration.wizards import Step, Wizard, WizardSession, ask
from smartcam.exceptions import CalibrationError, NotRunningError
from tests.calibration.inside import MAX_LINE_BYTES, Journal
from tests.calibration.inside import _journal as module
from tests.calibration.wizards import wizards
from tests.calibration.wizards.wizards import ANSWERS, Trigger, answer_all, survey


def started(*errors: BaseException) -> tuple[WizardSession, Trigger]:
    trigger = Trigger(*errors)
    return WizardSession(survey(trigger), parameters={"by": "test"}), trigger


RESULT = {
    "by": "test", "name": "bench", "unit": "mm", "fixed": True,
    "picture": {"shot": 1, "at": [0.1, 1e-05]}, "values": [1.5, 2.5],
}  # fmt: skip


# ---------------------------------------------------------------------- going on


async def test_session_answered_gives_the_result() -> None:
    session, trigger = started()
    view = await answer_all(session)
    assert (view["type"], view["result"], view["can"]) == ("result", RESULT, [])
    assert (session.state, session.result, session.step) == ("ended", RESULT, None)
    assert trigger.count == 1
    assert [one["step"] for one in session.samples] == [
        "name", "picture", "more", "value-0", "value-1",
    ]  # fmt: skip


def test_current_has_all_fields_of_a_front_end() -> None:
    session, _ = started()
    view = session.current
    assert json.loads(json.dumps(view)) == view
    assert (view["type"], view["step"], view["title"], view["button"]) == (
        "form", "name", "Name", "Next",
    )  # fmt: skip
    assert view["defaults"] == {"unit": "mm", "fixed": True}
    assert view["schema"]["required"] == ["name"]
    assert view["can"] == ["abort"]
    session.close()


async def test_submit_of_wrong_answers_keeps_the_step_and_names_each() -> None:
    session, _ = started()
    token = session.token
    view = await session.submit(token, {"name": "A B", "unit": "inch", "z": 1})
    assert view["errors"] == {
        "name": "'A B': expected small letters",
        "unit": "'inch': expected one of mm, m",
        "base": "'z': no such input; this step asks for name, unit, fixed",
    }
    assert (view["step"], view["token"]) == ("name", token)
    view = await session.submit(token, {"name": "a"})
    assert (view["step"], view["errors"]) == ("picture", {})
    session.close()


@pytest.mark.parametrize(
    ("error", "text"), [(NotRunningError("stopped"), "stopped"), (OSError("no disk"), "no disk")]
)
async def test_submit_with_a_failing_action_keeps_the_step(error: Exception, text: str) -> None:
    session, trigger = started(error)
    view = await answer_all(session, until=1)
    view = await session.submit(view["token"])
    assert (view["step"], view["errors"]) == ("picture", {"base": text})
    view = await answer_all(session)
    assert (view["type"], trigger.count) == ("result", 2)


async def test_submit_that_the_wizard_refuses_keeps_the_step() -> None:
    session, _ = started()
    view = await answer_all(session, until=4)
    view = await session.submit(view["token"], {"value": 1.5})
    assert (view["step"], view["errors"]) == ("value-1", {"base": "1.5 came before"})
    assert len(session.samples) == 4
    view = await session.submit(view["token"], {"value": 2.5})
    assert view["result"] == RESULT


async def test_submit_with_a_bug_in_the_action_raises_and_keeps_the_step() -> None:
    session, trigger = started(KeyError("bug"))
    view = await answer_all(session, until=1)
    with pytest.raises(KeyError, match="bug"):
        await session.submit(view["token"])
    assert session.current["step"] == "picture"
    assert (await answer_all(session))["type"] == "result"
    assert trigger.count == 2


async def test_submit_whose_action_hangs_ends_in_time() -> None:
    async def hang(_: object) -> None:
        await asyncio.Event().wait()

    session = WizardSession(survey(hang))
    view = await answer_all(session, until=1)
    view = await session.submit(view["token"])
    assert view["errors"] == {"base": "nothing came within 60 s"}
    session.close()


async def test_submit_cancelled_keeps_the_step() -> None:
    began = asyncio.Event()

    async def hang(_: object) -> None:
        began.set()
        await asyncio.Event().wait()

    session = WizardSession(survey(hang))
    view = await answer_all(session, until=1)
    task = asyncio.ensure_future(session.submit(view["token"]))
    await began.wait()
    assert session.current["type"] == "progress"
    task.cancel()
    await asyncio.wait({task})
    assert (session.current["step"], session.current["type"]) == ("picture", "confirm")
    assert len(session.samples) == 1
    session.close()


async def test_outcome_that_is_no_json_keeps_the_step() -> None:
    async def act(_: object) -> object:
        return float("nan")

    session = WizardSession(survey(act))
    view = await answer_all(session, until=1)
    view = await session.submit(view["token"])
    assert "step 'picture': its outcome cannot be stored" in view["errors"]["base"]
    session.close()


def test_wizard_that_awaits_something_else_is_a_type_error() -> None:
    async def script(_: Mapping[str, Any]) -> None:
        await asyncio.sleep(0)

    with pytest.raises(TypeError, match="a wizard awaits steps only, not None"):
        WizardSession(Wizard(name="bad", version=1, script=script))


# ---------------------------------------------------------------------- tokens


async def test_submit_again_with_the_same_token_and_answers_changes_nothing() -> None:
    session, trigger = started()
    view = await answer_all(session, until=1)
    first, second = await asyncio.gather(
        session.submit(view["token"]), session.submit(view["token"])
    )
    assert first == second
    assert (first["step"], trigger.count) == ("more", 1)
    session.close()


async def test_submit_with_an_old_token_and_other_answers_is_refused() -> None:
    session, _ = started()
    token = session.token
    await session.submit(token, {"name": "a"})
    with pytest.raises(CalibrationError, match="the step has changed meanwhile") as caught:
        await session.submit(token, {"name": "b"})
    assert (caught.value.code, caught.value.got) == ("STALE_STEP", token)
    session.close()


async def test_submit_after_the_end_is_refused() -> None:
    session, _ = started()
    view = await answer_all(session)
    with pytest.raises(CalibrationError, match=r"the sequence is over \(ended\)") as caught:
        await session.submit(view["token"], {"value": 3})
    assert caught.value.code == "NOT_POSSIBLE"


# ---------------------------------------------------------------------- back and again


async def test_undo_goes_back_a_step_and_keeps_its_answers_as_defaults() -> None:
    session, trigger = started()
    await answer_all(session, until=4)
    view = await session.undo(session.token)
    assert (view["step"], view["defaults"]) == ("value-0", {"value": 1.5})
    view = await session.undo(view["token"])
    assert (view["step"], view["defaults"]) == ("more", {"count": 2})
    assert trigger.count == 1
    assert (await answer_all(session))["result"] == RESULT


async def test_undo_twice_with_one_token_undoes_once() -> None:
    session, _ = started()
    view = await answer_all(session, until=3)
    again = [await session.undo(view["token"]) for _ in range(2)]
    assert again[0] == again[1]
    assert again[0]["step"] == "more"
    session.close()


async def test_undo_at_the_first_step_is_refused() -> None:
    session, _ = started()
    with pytest.raises(CalibrationError, match="undo: not possible here; expected one of abort"):
        await session.undo(session.token)
    session.close()


async def test_undo_takes_the_answer_the_token_changes_so_an_old_answer_is_stale() -> None:
    session, _ = started()
    first = session.token
    await session.submit(first, {"name": "a"})
    await session.undo(session.token)
    with pytest.raises(CalibrationError):
        await session.submit(first, {"name": "a"})
    session.close()


async def test_repeat_does_the_action_again() -> None:
    session, trigger = started()
    view = await answer_all(session, until=2)
    assert view["can"] == ["undo", "repeat", "abort"]
    view = await session.repeat(view["token"])
    assert (view["step"], trigger.count) == ("more", 2)
    assert session.samples[1]["outcome"] == {"shot": 2, "at": [0.1, 1e-05]}
    assert (await answer_all(session))["result"]["picture"]["shot"] == 2


async def test_repeat_that_fails_keeps_the_old_outcome() -> None:
    session, trigger = started()
    view = await answer_all(session, until=2)
    trigger.errors.append(NotRunningError("stopped"))
    view = await session.repeat(view["token"])
    assert (view["step"], view["errors"]) == ("more", {"base": "stopped"})
    assert (await answer_all(session))["result"] == RESULT


async def test_repeat_of_a_step_without_an_action_is_refused() -> None:
    session, _ = started()
    view = await answer_all(session, until=1)
    with pytest.raises(CalibrationError, match="repeat: not possible here"):
        await session.repeat(view["token"])
    session.close()


async def test_abort_ends_the_sequence() -> None:
    session, _ = started()
    view = await answer_all(session, until=2)
    view = await session.abort(view["token"])
    assert (view["type"], view["can"], view["result"]) == ("abort", [], None)
    with pytest.raises(CalibrationError, match=r"over \(aborted\)"):
        await session.submit(view["token"], {"count": 1})


async def test_abort_cuts_off_an_action() -> None:
    began = asyncio.Event()

    async def hang(_: object) -> None:
        began.set()
        await asyncio.Event().wait()

    async def script(_: Mapping[str, Any]) -> None:
        await ask(Step(id="long", title="Long", timeout=1000), hang)

    session = WizardSession(Wizard(name="long", version=1, script=script))
    async with asyncio.timeout(5), asyncio.TaskGroup() as tasks:
        work = tasks.create_task(session.submit(session.token))
        await began.wait()
        end = tasks.create_task(session.abort(session.token))
    assert work.result()["type"] == "confirm"
    assert end.result()["type"] == "abort"


# ---------------------------------------------------------------------- journals


async def test_journal_resumed_at_each_step_goes_on_without_an_action(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    trigger = Trigger()
    for number in range(len(ANSWERS)):
        session = WizardSession(survey(trigger), Journal(path), parameters={"by": "test"})
        assert session.current["number"] == number + 1
        await answer_all(session, until=number + 1)
        session.close()
    session = WizardSession(survey(trigger), Journal(path))
    assert (session.result, trigger.count) == (RESULT, 1)
    session.close()


async def test_journal_keeps_what_was_undone_and_the_token(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    session = WizardSession(survey(Trigger()), Journal(path))
    view = await answer_all(session, until=4)
    view = await session.undo(view["token"])
    session.close()
    again = WizardSession(survey(Trigger()), Journal(path))
    assert again.current == view
    assert '"value":1.5' in path.read_text()
    again.close()


async def test_submit_again_after_a_crash_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    session = WizardSession(survey(Trigger()), Journal(path))
    view = await answer_all(session, until=3)
    token = view["token"]
    view = await session.submit(token, {"value": 1.5})
    session.close()
    again = WizardSession(survey(Trigger()), Journal(path))
    assert await again.submit(token, {"value": 1.5}) == view
    again.close()


def test_journal_of_another_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    wizard = survey(Trigger())
    WizardSession(wizard, Journal(path)).close()
    other = Wizard(name="survey", version=2, script=wizard.script)
    with Journal(path) as journal, pytest.raises(CalibrationError) as caught:
        WizardSession(other, journal)
    assert caught.value.code == "WRONG_JOURNAL"
    assert "written by 'survey' version 1" in str(caught.value)


def test_journal_of_other_steps_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    WizardSession(survey(Trigger()), Journal(path)).close()
    entry: dict[str, Any] = {
        "event": "answer",
        "token": "",
        "step": "else",
        "answers": {},
        "outcome": None,
        "acted": False,
        "at": "",
    }
    with Journal(path) as journal:
        journal.append(entry)
        with pytest.raises(CalibrationError, match="entry 1 is of step 'else', expected step 'na"):
            WizardSession(survey(Trigger()), journal)


@pytest.mark.parametrize(
    "entry", [{"event": "undo", "token": ""}, {"event": "answer"}, {"event": "dance"}, {}]
)
def test_journal_that_is_incomplete_is_refused(tmp_path: Path, entry: dict[str, Any]) -> None:
    path = tmp_path / "journal.jsonl"
    WizardSession(survey(Trigger()), Journal(path)).close()
    with Journal(path) as journal:
        journal.append(entry)
        with pytest.raises(CalibrationError, match="the journal is incomplete") as caught:
            WizardSession(survey(Trigger()), journal)
    assert caught.value.code == "BROKEN_FILE"


def test_parameters_that_are_no_json_are_refused() -> None:
    with pytest.raises(CalibrationError, match="the parameters cannot be stored"):
        WizardSession(survey(Trigger()), parameters={"x": float("inf")})


async def test_submit_onto_a_full_disk_keeps_the_step(tmp_path: Path) -> None:
    class Full(Journal):
        full = False

        def _write_bytes(self, line: bytes) -> None:
            super()._write_bytes(line[:9] if self.full else line)
            if self.full:
                raise OSError("no space left")

    path = tmp_path / "journal.jsonl"
    journal = Full(path)
    session = WizardSession(survey(Trigger()), journal, parameters={"by": "test"})
    view = await answer_all(session, until=3)
    journal.full = True
    view = await session.submit(view["token"], {"value": 1.5})
    assert (view["step"], view["errors"]) == ("value-0", {"base": "no space left"})
    journal.full = False
    assert (await answer_all(session))["result"] == RESULT
    session.close()
    again = WizardSession(survey(Trigger()), Journal(path))
    assert again.result == RESULT
    again.close()


def drive(path: Path, answers: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Run the survey in a process, which is killed after its report of each answer."""
    with start(path) as process:
        told = [json.loads(readline(process))]
        for one in answers:
            writeline(process, one)
            told.append(json.loads(readline(process)))
        process.kill()
    return told


def start(path: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(  # noqa: S603 - our own interpreter
        [sys.executable, "-m", wizards.__name__, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        bufsize=1,
    )


def readline(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline()


def writeline(process: subprocess.Popen[str], answers: dict[str, Any]) -> None:
    assert process.stdin is not None
    process.stdin.write(json.dumps(answers) + "\n")


@pytest.mark.long
def test_process_killed_at_every_step_loses_nothing(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    triggers = 0
    for number, answer in enumerate(ANSWERS):
        before, after = drive(path, [answer])
        assert (before["number"], before["triggers"]) == (number + 1, 0)
        assert after["number"] == number + 2
        triggers += after["triggers"]
    session = WizardSession(survey(Trigger()), Journal(path))
    assert session.result["values"] == [1.5, 2.5]
    assert triggers == 1
    session.close()


@pytest.mark.long
def test_process_killed_before_its_answer_does_the_step_or_leaves_it(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    number = 1
    for answer in ANSWERS:
        with start(path) as process:
            assert json.loads(readline(process))["number"] == number
            writeline(process, answer)
            process.kill()
        (told,) = drive(path, [])
        assert told["number"] in {number, number + 1}
        if told["number"] == number:
            _, told = drive(path, [answer])
        number = told["number"]
    session = WizardSession(survey(Trigger()), Journal(path))
    assert session.result["values"] == [1.5, 2.5]
    session.close()


async def test_journal_cut_at_every_byte_loses_the_last_line_only(tmp_path: Path) -> None:
    path, cut = tmp_path / "journal.jsonl", tmp_path / "cut.jsonl"
    session = WizardSession(survey(Trigger()), Journal(path), parameters={"by": "test"})
    await answer_all(session)
    session.close()
    body = path.read_bytes()
    head = body.index(b"\n") + 1
    for size in range(head, len(body) + 1):
        cut.write_bytes(body[:size])
        with Journal(cut) as journal:
            again = WizardSession(survey(Trigger()), journal)
            assert again.current["number"] == body[:size].count(b"\n")
            assert cut.read_bytes() == body[: body.rfind(b"\n", 0, size) + 1]
            again.close()


def test_journal_with_answers_of_another_sequence_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    WizardSession(survey(Trigger()), Journal(path)).close()
    names = {"event": "answer", "token": "", "outcome": None, "acted": False, "at": ""}
    with Journal(path) as journal:
        for step in ("name", "picture", "more"):
            journal.append({**names, "step": step, "answers": {"cOunt": 1}})
        with pytest.raises(
            CalibrationError, match=r"not lead through 'survey': KeyError"
        ) as caught:
            WizardSession(survey(Trigger()), journal)
    assert caught.value.code == "BROKEN_FILE"


# ----------------------------------------------------------------------
# The journal keeps written entries; broken files and files in use are refused.


def test_entries_are_read_again_as_they_were_written(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    with Journal(path) as journal:
        assert (journal.header, journal.entries) == (None, [])
        journal.start({"wizard": "w"})
        assert journal.append({"at": (1, 0.1)}) == {"at": [1, 0.1]}
    with Journal(path) as journal:
        assert (journal.header, journal.entries) == ({"wizard": "w"}, [{"at": [1, 0.1]}])
        journal.append({"n": 2})
    assert path.read_text() == '{"wizard":"w"}\n{"at":[1,0.1]}\n{"n":2}\n'


@pytest.mark.parametrize(
    ("body", "text"),
    [(b"{}\nhello\n{}\n", "line 2 is no JSON"), (b"{}\n[1]\n", "line 2 is no object")],
)
def test_journal_that_is_broken_within_is_refused(tmp_path: Path, body: bytes, text: str) -> None:
    path = tmp_path / "a.journal"
    path.write_bytes(body)
    with pytest.raises(CalibrationError, match=text) as caught:
        Journal(path)
    assert caught.value.code == "BROKEN_FILE"
    assert path.read_bytes() == body


def test_journal_in_use_is_refused_until_it_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "a.journal"
    with Journal(path), pytest.raises(CalibrationError, match="another sequence writes it"):
        Journal(path)
    Journal(path).close()


@pytest.mark.parametrize(
    ("value", "text"),
    [(float("nan"), "cannot be stored"), ("x" * MAX_LINE_BYTES, "expected 1048576 at most")],
)
def test_entry_that_cannot_be_kept_is_refused(tmp_path: Path, value: object, text: str) -> None:
    with Journal(tmp_path / "a.journal") as journal:
        journal.start({})
        with pytest.raises(CalibrationError, match=text) as caught:
            journal.append({"value": value})
        assert caught.value.code == "NOT_STORABLE"
    assert (tmp_path / "a.journal").read_text() == "{}\n"


def test_journal_takes_no_more_than_its_bound(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "MAX_ENTRIES", 2)
    with Journal(tmp_path / "a.journal") as journal:
        journal.start({})
        for number in range(2):
            journal.append({"n": number})
        with pytest.raises(CalibrationError, match="entry 3, expected 2 at most"):
            journal.append({"n": 2})


def test_journal_that_is_a_link_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.journal").symlink_to(tmp_path / "made")
    with pytest.raises(OSError, match="symbolic links"):
        Journal(tmp_path / "a.journal")
    assert not (tmp_path / "made").exists()
