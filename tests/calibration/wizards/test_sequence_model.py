"""Compare a session with a plain model: any actions in any order, interrupted anywhere."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Coroutine, Mapping
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from smartcam.calibration.wizards import Number, Step, Wizard, WizardSession, ask
from smartcam.exceptions import CalibrationError
from tests.calibration.inside import Journal

LENGTH = 6


class Sequences(RuleBasedStateMachine):
    """The model: answers and counts of actions, in a list. Odd steps have an action."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        self.path = Path(self.folder.name) / "a.journal"
        self.actions = 0
        self.fails = False
        self.model: list[tuple[int, int | None]] = []
        self.aborted = False
        self.loop = asyncio.new_event_loop()
        self.session = self.opened()

    def opened(self) -> WizardSession:
        return WizardSession(
            Wizard(name="model", version=1, script=self.script), Journal(self.path)
        )

    async def script(self, _: Mapping[str, Any]) -> Any:
        found: list[tuple[int, int | None]] = []
        for index in range(LENGTH):
            number = Number(name="n", label="N", integer=True)
            step = Step(id=f"step-{index}", title="Step", inputs=(number,))
            answer = await ask(step, self.act if index % 2 else None)
            if answer["n"] == 13:
                raise CalibrationError("thirteen", code="UNLUCKY")
            found.append((answer["n"], answer.outcome))
        return found

    async def act(self, _: object) -> int:
        self.actions += 1
        if self.fails:
            raise OSError("broken")
        return self.actions

    def do(self, call: Coroutine[Any, Any, dict[str, Any]]) -> dict[str, Any]:
        return self.loop.run_until_complete(call)

    def is_asking(self) -> bool:
        return not self.aborted and len(self.model) < LENGTH

    def has_acted(self) -> bool:
        return self.is_asking() and len(self.model) % 2 == 0 and bool(self.model)

    @precondition(is_asking)
    @rule(number=st.integers(0, 3), again=st.booleans())
    def answer(self, number: int, again: bool) -> None:
        token, acts = self.session.token, len(self.model) % 2
        view = self.do(self.session.submit(token, {"n": number}))
        self.model.append((number, self.actions if acts else None))
        if again:
            assert self.do(self.session.submit(token, {"n": number})) == view

    @precondition(is_asking)
    @rule(number=st.sampled_from([13, 1.5, "x"]))
    def answer_wrongly(self, number: object) -> None:
        view = self.do(self.session.submit(self.session.token, {"n": number}))
        assert view["errors"]

    @precondition(has_acted)
    @rule(fails=st.booleans())
    def repeat(self, fails: bool) -> None:
        self.fails = fails
        view = self.do(self.session.repeat(self.session.token))
        self.fails = False
        assert view["errors"] == ({"base": "broken"} if fails else {})
        if not fails:
            self.model[-1] = (self.model[-1][0], self.actions)

    @precondition(is_asking)
    @rule()
    def undo(self) -> None:
        if self.model:
            view = self.do(self.session.undo(self.session.token))
            assert view["defaults"]["n"] == self.model.pop()[0]
        else:
            with pytest.raises(CalibrationError, match="not possible here"):
                self.do(self.session.undo(self.session.token))

    @precondition(lambda self: self.is_asking() and len(self.model) > 3)
    @rule()
    def abort(self) -> None:
        self.do(self.session.abort(self.session.token))
        self.aborted = True

    @rule(torn=st.binary(max_size=9).filter(lambda data: b"\n" not in data))
    def break_off_and_go_on(self, torn: bytes) -> None:
        actions = self.actions
        before = self.session.current
        self.session.close()
        with self.path.open("ab") as stream:
            stream.write(torn)
        self.session = self.opened()
        assert self.session.current == {**before, "errors": {}}
        assert self.actions == actions

    @invariant()
    def session_is_as_the_model(self) -> None:
        samples = [(one["answers"]["n"], one["outcome"]) for one in self.session.samples]
        assert samples == self.model
        state = "aborted" if self.aborted else "asking" if len(samples) < LENGTH else "ended"
        assert self.session.state == state
        if state == "ended":
            assert self.session.result == self.model
        elif state == "asking":
            assert self.session.current["step"] == f"step-{len(samples)}"

    def teardown(self) -> None:
        self.session.close()
        self.loop.close()
        self.folder.cleanup()


TestSequences = Sequences.TestCase
TestSequences.settings = settings(max_examples=max(1, settings().max_examples // 2))
