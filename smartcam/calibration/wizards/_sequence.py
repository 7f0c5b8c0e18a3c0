r"""Run wizards: a wizard is a coroutine that asks for steps; a sequence is one run of it.

::

    async def greet(parameters):
        answer = await ask(Step(id="name", title="Who?", inputs=(Text(name="name", label="Name"),)))
        return f"Hello {answer['name']}"

    session = WizardSession(Wizard(name="greet", version=1, script=greet))
    step = session.current                                    # JSON-able: what to show
    step = await session.submit(step["token"], {"name": "Ada"})

How it works: the coroutine awaits only :func:`ask`. Everything that uses a camera, a robot or a
file is an *action* of a step: an async function that runs when the step is answered, and whose
outcome is written into the journal together with the answers. So the list of answers
and outcomes is the whole state of the coroutine. Undo runs the coroutine again with one entry less;
resuming after a crash runs it again with all entries. Neither undo nor resuming runs an action
again.

After an error the step is shown again, whether the answer was wrong, the action failed, or the
coroutine failed before its next step. Only an answer that the coroutine accepts is written.
"""

from __future__ import annotations

import asyncio
import contextlib
import copy
import functools
import hashlib
import json
import secrets
from collections.abc import Awaitable, Callable, Coroutine, Generator, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Literal

from smartcam.exceptions import CalibrationError, SmartCamError
from smartcam.geometry._inside import Code

if TYPE_CHECKING:
    from smartcam.calibration.wizards._journal import Journal
    from smartcam.calibration.wizards._steps import Answers, Step

SCHEMA = "smartcam.sequence/2"
"""Name of the journal's form, in its first line."""

Action = Callable[["Answers"], Awaitable[Any]]
"""Function that runs when a step is answered: takes the answers, returns JSON data.

If the function raises a SmartCamError or an OSError, such as TimeoutError, the error is shown and
the step stays. If it raises a CalibrationError with the code ``WRONG_ANSWERS``, whose ``got`` maps
inputs to texts, each text is shown at its input.
"""

State = Literal["asking", "ended", "aborted"]
"""State of a sequence."""


class StepAnswer(dict[str, Any]):
    """Answers to a step by name, and the outcome of its action.

    Attributes:
        outcome: the action's result as JSON data (lists for tuples); None without an action.
    """

    def __init__(self, values: Mapping[str, Any], outcome: Any) -> None:
        super().__init__(values)
        self.outcome: Any = outcome


@dataclass(frozen=True, slots=True)
class PendingStep:
    """A step to be answered, which a wizard awaits.

    Attributes:
        step: the step.
        action: function that runs with the answers; None for nothing.
    """

    step: Step
    action: Action | None = None

    def __await__(self) -> Generator[PendingStep, StepAnswer, StepAnswer]:
        return (yield self)


def ask(step: Step, action: Action | None = None) -> PendingStep:
    """Return an awaitable that shows a step and waits for its answer.

    Args:
        step: the step to show.
        action: function that runs once, when the step is answered.

    Returns:
        An awaitable of the :class:`StepAnswer`.
    """
    return PendingStep(step, action)


@dataclass(frozen=True, slots=True, kw_only=True)
class Wizard:
    """A coroutine function that can be run as a sequence of steps, and facts about it.

    Attributes:
        name: name of the wizard in journals.
        version: number to raise when the steps change; a journal of another version is not resumed.
        script: the coroutine function; takes the parameters of the start, returns the result.
        steps: usual number of steps; 0 if it is not known.
    """

    name: str
    version: int
    script: Callable[[Mapping[str, Any]], Coroutine[Any, Any, Any]]
    steps: int = 0


class _ScriptRun:
    """A run of the coroutine, up to the step after given entries of the journal."""

    def __init__(
        self, wizard: Wizard, parameters: Mapping[str, Any], entries: list[dict[str, Any]]
    ) -> None:
        self._coroutine = wizard.script(copy.deepcopy(dict(parameters)))
        self.pending: PendingStep | None = None
        self.last: Step | None = None  # the step that was answered last
        self.result: Any = None
        self._send(None)
        for number, entry in enumerate(entries, 1):
            if self.pending is None or self.pending.step.id != entry["step"]:
                place = "the end" if self.pending is None else f"step {self.pending.step.id!r}"
                self.close()
                raise Code.WRONG_JOURNAL.error(
                    f"entry {number} is of step {entry['step']!r}, expected {place}: another "
                    f"version of {wizard.name!r} wrote it"
                )
            self.send_entry(entry)

    def send_entry(self, entry: Mapping[str, Any]) -> None:
        """Send an entry's answers and outcome to the coroutine."""
        self._send(StepAnswer(copy.deepcopy(entry["answers"]), copy.deepcopy(entry["outcome"])))

    def _send(self, answer: StepAnswer | None) -> None:
        self.last = None if self.pending is None else self.pending.step
        try:
            pending = self._coroutine.send(answer)
        except StopIteration as stop:
            self.pending, self.result = None, stop.value
            return
        if not isinstance(pending, PendingStep):
            self._coroutine.close()
            raise TypeError(f"a wizard awaits steps only, not {pending!r}: that is for an action")
        self.pending = pending

    def close(self) -> None:
        self._coroutine.close()


_ANSWER_KEYS = ("token", "step", "answers", "outcome", "acted", "at")
_KEYS_BY_EVENT = {
    "answer": _ANSWER_KEYS,
    "repeat": _ANSWER_KEYS,
    "undo": ("token",),
    "abort": ("token",),
}
"""Keys that an entry must have, by the entry's event."""


@dataclass(slots=True)
class _SequenceLog:
    """The entries of a sequence's journal that count, and the state that follows from them."""

    entries: list[dict[str, Any]] = field(default_factory=list[dict[str, Any]])
    state: State = "asking"
    undone: Mapping[str, Any] | None = None

    def with_entry(self, entry: dict[str, Any]) -> _SequenceLog:
        """Return the state after one more entry; raise KeyError if the entry lacks a key."""
        for name in _KEYS_BY_EVENT[entry["event"]]:
            _ = entry[name]
        match entry["event"]:
            case "answer":
                return _SequenceLog([*self.entries, entry])
            case "repeat":
                return _SequenceLog([*self.entries[:-1], entry])
            case "undo":
                return _SequenceLog(self.entries[:-1], undone=self.entries[-1])
            case _:
                return _SequenceLog(self.entries, "aborted")


class WizardSession:
    """A running sequence. Concurrent calls wait for each other.

    Args:
        wizard: the wizard.
        journal: journal of the steps; a journal with entries is resumed. None: steps are not kept.
        parameters: JSON values for the wizard's start; a resumed journal has its own values.

    Attributes:
        wizard: the wizard.
        run_id: name of this run, which its tokens begin with.
        parameters: the parameters with which the wizard was started.
        resumed: facts about a resumed journal: ``since`` and ``last``, the times at which it was
            begun and last written, ``done``, its answers, and its ``parameters``. None for a new
            journal, and once the sequence goes on.

    Raises:
        CalibrationError: ``WRONG_JOURNAL``: the journal belongs to another wizard or version;
            ``BROKEN_FILE``: the journal is damaged; ``NOT_STORABLE``: the parameters are not
            possible as JSON; or the wizard's error about the parameters.
        OSError: the journal cannot be written.
    """

    def __init__(
        self,
        wizard: Wizard,
        journal: Journal | None = None,
        *,
        parameters: Mapping[str, Any] | None = None,
    ) -> None:
        self.wizard: Wizard = wizard
        self._journal = journal
        header = self._make_header(parameters or {})
        self._all_entries: list[dict[str, Any]] = [] if journal is None else list(journal.entries)
        try:
            self.run_id: str = str(header["run_id"])
            self.parameters: dict[str, Any] = dict(header["parameters"])
            self._log = functools.reduce(_SequenceLog.with_entry, self._all_entries, _SequenceLog())
        except (KeyError, IndexError, TypeError, ValueError) as exc:
            raise Code.BROKEN_FILE.error(
                f"the journal is incomplete: {exc!r}; expected a journal as a sequence writes it"
            ) from exc
        self._script_run = self._replay_entries()
        if journal is not None and journal.header is None:
            journal.start(header)
        self.resumed: dict[str, Any] | None = self._resumed_facts(header)
        self._errors: dict[str, str] = {}
        self._lock = asyncio.Lock()
        self._action_timeout: asyncio.Timeout | None = None

    def _resumed_facts(self, header: Mapping[str, Any]) -> dict[str, Any] | None:
        """Return facts about the resumed journal; None if there is nothing to resume.

        Front-ends show these facts, since marks that the robot touched may have moved meanwhile.
        """
        if self.state != "asking" or not self._log.entries:
            return None
        done = [
            {"step": entry["step"], "answers": entry["answers"], "at": entry["at"]}
            for entry in copy.deepcopy(self._log.entries)
        ]
        times = {"since": header.get("started_at"), "last": done[-1]["at"]}
        return {**times, "done": done, "parameters": copy.deepcopy(self.parameters)}

    def _replay_entries(self) -> _ScriptRun:
        try:
            return _ScriptRun(self.wizard, self.parameters, self._log.entries)
        except (AttributeError, LookupError, TypeError, ValueError) as exc:
            if isinstance(exc, SmartCamError) or not self._log.entries:
                raise
            raise Code.BROKEN_FILE.error(
                f"the journal's answers do not lead through {self.wizard.name!r}: {exc!r}; "
                "expected answers that its steps accept"
            ) from exc

    def _make_header(self, parameters: Mapping[str, Any]) -> dict[str, Any]:
        wizard, journal = self.wizard, self._journal
        expected = {"schema": SCHEMA, "wizard": wizard.name, "version": wizard.version}
        if journal is not None and journal.header is not None:
            actual = {name: journal.header.get(name) for name in expected}
            if actual != expected:
                raise Code.WRONG_JOURNAL.error(
                    f"{journal.path}: written by {_describe_wizard(actual)}, expected "
                    f"{_describe_wizard(expected)}",
                    expected,
                    actual,
                )
            return journal.header
        return {
            **expected,
            "run_id": secrets.token_hex(8),
            "started_at": datetime.now(UTC).isoformat(),
            "parameters": _as_stored(dict(parameters), "the parameters"),
        }

    @property
    def state(self) -> State:
        """State of the wizard."""
        if self._log.state == "asking" and self._script_run.pending is None:
            return "ended"
        return self._log.state

    @property
    def result(self) -> Any:
        """Return value of the wizard; None before its end."""
        return self._script_run.result

    @property
    def step(self) -> Step | None:
        """The current step; None at the end, and after an abort."""
        pending = self._script_run.pending
        return None if pending is None or self.state != "asking" else pending.step

    @property
    def busy(self) -> bool:
        """True while a call is under way."""
        return self._lock.locked()

    @property
    def samples(self) -> list[dict[str, Any]]:
        """Answers and outcomes that were not undone, in order.

        Each has ``step``, ``answers``, ``outcome`` and ``at``.
        """
        keys = ("step", "answers", "outcome", "at")
        return [{name: copy.deepcopy(entry[name]) for name in keys} for entry in self._log.entries]

    @property
    def token(self) -> str:
        """Text that a call must send back, so that no call counts twice; each entry changes it."""
        return f"{self.run_id}.{len(self._all_entries)}"

    @property
    def current(self) -> dict[str, Any]:
        """The current step as JSON data, for a front-end to show.

        Returns:
            A dict with ``run_id``, ``wizard``, ``token``, ``type``, ``number`` (of the step, from
            1), ``of`` (about how many steps; None: not known), ``step`` (its id), ``title``,
            ``description``, ``button``, ``notes``, ``verdict`` (``level``, ``text``), ``preview``,
            ``waiting``, ``schema``, ``defaults``, ``errors`` (a text for each input, ``base`` for
            other errors), ``can`` (the possible calls among ``undo``, ``repeat``, ``abort``) and
            ``result``. ``type`` is ``form`` (with inputs), ``confirm`` (without inputs),
            ``progress`` (the step's action is under way), ``result`` (with the verdict and the
            preview of the last step) or ``abort``.
        """
        view: dict[str, Any] = {
            "run_id": self.run_id,
            "wizard": self.wizard.name,
            "token": self.token,
            "type": {"ended": "result", "aborted": "abort"}.get(self.state, "confirm"),
            "number": len(self._log.entries) + 1,
            "of": self._count_steps(),
            "errors": dict(self._errors),
            "can": self._possible_calls(),
            "result": self.result,
        }
        step = self.step
        if step is None:
            last = self._script_run.last if self.state == "ended" else None
            return view if last is None else {**view, **_verdict_and_preview(last)}
        if self._action_timeout is not None:
            view["type"] = "progress"
        elif step.inputs:
            view["type"] = "form"
        return {
            **view,
            "step": step.id,
            "title": step.title,
            "description": step.description,
            "button": step.button,
            "notes": list(step.notes),
            **_verdict_and_preview(step),
            "waiting": step.waiting,
            "schema": step.schema(),
            "defaults": self._defaults(step),
        }

    def _count_steps(self) -> int | None:
        """Return the approximate number of steps; None: not known."""
        if not self.wizard.steps or self.step is None:
            return None
        remaining = {"save": 0, "review": 1}.get(self.step.id, 2)
        return max(self.wizard.steps, len(self._log.entries) + 1 + remaining)

    def _possible_calls(self) -> list[str]:
        if self.state != "asking":
            return []
        entries = self._log.entries
        undo = ["undo"] if entries else []
        repeat = ["repeat"] if entries and entries[-1].get("acted") else []
        return [*undo, *repeat, "abort"]

    def _defaults(self, step: Step) -> Answers:
        undone = self._log.undone
        if undone is None or undone["step"] != step.id:
            return step.defaults()
        return {**step.defaults(), **undone["answers"]}

    async def submit(self, token: str, answers: object = None) -> dict[str, Any]:
        """Answer the current step.

        Args:
            token: token of the step. The previous token with the same answers changes nothing, so
                that a call whose reply was lost can be repeated.
            answers: answers by the names of inputs; None for none.

        Returns:
            :attr:`current`: the next step, or the same one with ``errors``.

        Raises:
            CalibrationError: ``STALE_STEP`` or ``NOT_POSSIBLE``.

        Cancellation: the action is cancelled and the step stays, unless it was already accepted.
        """
        given = {} if answers is None else answers
        async with self._lock:
            if self._is_repeated_call("answer", token, given):
                return self.current
            pending = self._require_token(token)
            with self._keep_errors():
                values = pending.step.checked(self._fill_defaults(pending.step, given))
                outcome = await self._run_action(pending, values)
                self._accept_answer(
                    self._script_run, self._make_entry("answer", pending, values, outcome, given)
                )
            return self.current

    def _fill_defaults(self, step: Step, given: object) -> object:
        return {**self._defaults(step), **given} if isinstance(given, Mapping) else given

    async def undo(self, token: str) -> dict[str, Any]:
        """Go back to the previous step, with its answers as defaults.

        Arguments, result and errors are those of :meth:`submit`.

        Raises:
            OSError: the journal cannot be written; nothing is undone.

        Cancellation: nothing is undone.
        """
        async with self._lock:
            if self._is_repeated_call("undo", token):
                return self.current
            run = self._rerun_to_last_step("undo", token)
            self._commit(run, {"event": "undo", "token": token})
            return self.current

    async def repeat(self, token: str) -> dict[str, Any]:
        """Run the action of the previous step again, with the same answers.

        The new outcome replaces the old one. An error is shown, and the old outcome stays.
        Arguments, result and errors are those of :meth:`submit`.

        Cancellation: the action is cancelled and the old outcome stays.
        """
        async with self._lock:
            if self._is_repeated_call("repeat", token):
                return self.current
            run, last = self._rerun_to_last_step("repeat", token), self._log.entries[-1]
            pending = run.pending
            if pending is None or pending.action is None:
                raise self._impossible_error("repeat")
            with self._keep_errors():
                outcome = await self._run_action(pending, last["answers"])
                self._accept_answer(
                    run, self._make_entry("repeat", pending, last["answers"], outcome, None)
                )
            return self.current

    async def abort(self, token: str) -> dict[str, Any]:
        """End the sequence without a result; a running action is cancelled.

        The journal keeps all entries. Arguments, result and errors are those of :meth:`submit`.

        Raises:
            OSError: the journal cannot be written; the sequence goes on.

        Cancellation: the sequence goes on, but a running action is cancelled nevertheless.
        """
        if self._action_timeout is not None and token == self.token:
            self._action_timeout.reschedule(asyncio.get_running_loop().time())
        async with self._lock:
            if self._is_repeated_call("abort", token):
                return self.current
            self._require_token(token)
            self._commit(self._script_run, {"event": "abort", "token": token})
            self._script_run.close()
            return self.current

    def close(self) -> None:
        """Free the coroutine and the journal; the sequence can be resumed from the journal."""
        self._script_run.close()
        if self._journal is not None:
            self._journal.close()

    def _is_repeated_call(self, event: str, token: str, given: object = None) -> bool:
        """Return True if the last entry is already the result of this call."""
        last = self._all_entries[-1] if self._all_entries else None
        return (
            last is not None
            and last["token"] == token
            and last["event"] == event
            and last.get("given") == (_digest(given) if event == "answer" else None)
        )

    def _require_token(self, token: str) -> PendingStep:
        pending = self._script_run.pending
        if self.state != "asking" or pending is None:
            raise Code.NOT_POSSIBLE.error(
                f"the sequence is over ({self.state}); expected one that asks", got=self.state
            )
        if token != self.token:
            raise Code.STALE_STEP.error(
                "the step has changed meanwhile: look at the current one", self.token, token
            )
        return pending

    def _rerun_to_last_step(self, label: str, token: str) -> _ScriptRun:
        """Run the coroutine again up to the last answered step; ``label`` names the call."""
        self._require_token(token)
        if label not in self._possible_calls():
            raise self._impossible_error(label)
        return _ScriptRun(self.wizard, self.parameters, self._log.entries[:-1])

    def _impossible_error(self, label: str) -> CalibrationError:
        return Code.NOT_POSSIBLE.error(
            f"{label}: not possible here; expected one of {', '.join(self._possible_calls())}",
            got=label,
        )

    async def _run_action(self, pending: PendingStep, values: Answers) -> Any:
        if pending.action is None:
            return None
        seconds = pending.step.timeout
        try:
            async with asyncio.timeout(seconds) as self._action_timeout:
                return await pending.action(copy.deepcopy(values))
        except TimeoutError as exc:
            if self._action_timeout is None or not self._action_timeout.expired():
                raise
            raise TimeoutError(f"nothing came within {seconds:g} s") from exc
        finally:
            self._action_timeout = None

    def _make_entry(
        self, event: str, pending: PendingStep, values: Answers, outcome: Any, given: object
    ) -> dict[str, Any]:
        entry = {
            "event": event,
            "token": self.token,
            "step": pending.step.id,
            "answers": values,
            "outcome": outcome,
            "acted": pending.action is not None,
            "given": _digest(given) if event == "answer" else None,
        }
        return _as_stored(entry, f"step {pending.step.id!r}: its outcome")

    def _accept_answer(self, run: _ScriptRun, entry: dict[str, Any]) -> None:
        """Send an entry to a run; keep both if the coroutine accepts the answer."""
        try:
            run.send_entry(entry)
            self._commit(run, entry)
        except BaseException:
            run.close()
            if run is self._script_run:
                self._script_run = _ScriptRun(self.wizard, self.parameters, self._log.entries)
            raise

    def _commit(self, run: _ScriptRun, entry: dict[str, Any]) -> None:
        entry = {**entry, "at": datetime.now(UTC).isoformat()}
        if self._journal is not None:
            entry = self._journal.append(entry)
        self._all_entries.append(entry)
        self._log = self._log.with_entry(entry)
        self.resumed = None
        if run is not self._script_run:
            self._script_run.close()
            self._script_run = run
        self._errors = {}

    @contextlib.contextmanager
    def _keep_errors(self) -> Iterator[None]:
        """Catch exceptions, and keep them as errors that the step shows."""
        self._errors = {}
        try:
            yield
        except (SmartCamError, OSError) as exc:
            errors: Any = {"base": str(exc)}
            if isinstance(exc, CalibrationError) and exc.code == Code.WRONG_ANSWERS:
                errors = exc.got
            self._errors = errors


def _verdict_and_preview(step: Step) -> dict[str, Any]:
    """Return a step's verdict and preview as JSON data."""
    return {
        "verdict": None if step.verdict is None else asdict(step.verdict),
        "preview": None if step.preview is None else dict(step.preview),
    }


def _describe_wizard(header: Mapping[str, Any]) -> str:
    return f"{header['wizard']!r} version {header['version']} ({header['schema']})"


def _as_stored(value: dict[str, Any], label: str) -> dict[str, Any]:
    """Return a value as JSON restores it, so that a resumed sequence has the same value."""
    try:
        stored: dict[str, Any] = json.loads(json.dumps(value, allow_nan=False))
    except (TypeError, ValueError) as exc:
        raise Code.NOT_STORABLE.error(f"{label} cannot be stored: {exc}") from exc
    return stored


def _digest(answers: object) -> str:
    text = json.dumps(answers, sort_keys=True, separators=(",", ":"), default=repr)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
