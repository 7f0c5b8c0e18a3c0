"""Run timelines: events that happen to an emulated camera without a client.

A timeline is a list of *cues*. A cue gives the moment (at a time, on entering a state, on command,
or from the beginning) and the faults that are injected then::

    timeline:
      - {at: 2.0, do: {kind: condition, condition: overheat}}
      - {entering: running, nth: 2, after: 0.5, do: {kind: stop}}
      - {command: jam, do: [{kind: no_result}, {kind: busy_for_ever, seconds: 3}]}
      - {do: {kind: drop, on: QueryAnswer, nth: 3}}

A fault that waits for a message (``on``, ``nth``) waits for it from that moment on. The same
timeline, the same seed and the same messages give the same bytes.
"""

from __future__ import annotations

import heapq
import itertools
import logging
from dataclasses import dataclass
from random import Random
from typing import TYPE_CHECKING, Annotated

from pydantic import BaseModel, BeforeValidator, Field, model_validator

from smartcam.emulator._clock import OneTimer, nanoseconds
from smartcam.emulator._data import EmulatorData
from smartcam.emulator._scenario.states import DeviceState
from smartcam.emulator.faults import Fault
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from pydantic import GetJsonSchemaHandler
    from pydantic.json_schema import JsonSchemaValue
    from pydantic_core import CoreSchema

    from smartcam.emulator._clock import Clock

_log = logging.getLogger("smartcam.emulator")

MAX_PENDING = 10_000
"""Largest number of cues that wait for their time; a further one is dropped, with a warning."""

MAX_CUES_AT_ONCE = 1000
"""Largest number of cues at one instant: cues that cause each other would never end. A further one
is dropped, with a warning."""

MAX_FAULTS_OF_CUE = 100
"""Largest number of faults of one cue, far more than useful."""

_MOMENTS = ("at", "entering", "command")

_Seconds = Annotated[float, Field(ge=0, le=86_400, allow_inf_nan=False)]


class _OneOrMore:
    """Allow a single fault instead of a list of one in a schema."""

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        array = handler(core_schema)
        return {"anyOf": [array["items"], array]}


def _as_list(value: object) -> object:
    return [value] if isinstance(value, (dict, BaseModel)) else value


class Cue(EmulatorData):
    """A moment, and the faults that are injected then.

    At most one of ``at``, ``entering`` and ``command`` gives the moment; without any it is the
    start of the emulator.
    """

    at: _Seconds | None = Field(default=None, description="seconds after the emulator's start")
    every: float | None = Field(
        default=None,
        ge=0.001,
        le=86_400,
        allow_inf_nan=False,
        description="seconds after which it happens again, each time; with `at`",
    )
    entering: DeviceState | None = Field(
        default=None, description="when the camera enters this state"
    )
    command: str | None = Field(
        default=None,
        min_length=1,
        max_length=100,
        pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$",
        description="when this command is given; several cues may have the same",
    )
    nth: int = Field(
        default=1,
        ge=1,
        le=1_000_000,
        description="number of the first occurrence it is for; with `entering` and `command`",
    )
    times: int | None = Field(
        default=None,
        ge=1,
        description=(
            "how often it applies, one time after the other; default once, with `every` and "
            "`command` as often as it comes"
        ),
    )
    after: _Seconds = Field(default=0.0, description="seconds later")
    spread: _Seconds = Field(default=0.0, description="largest random additional delay, uniform, s")
    chance: float = Field(
        default=1.0, gt=0, le=1, description="probability that it happens, each time"
    )
    do: Annotated[tuple[Fault, ...], _OneOrMore, BeforeValidator(_as_list)] = Field(
        description="one fault that is injected then, or several"
    )

    @model_validator(mode="after")
    def _check(self) -> Cue:
        moments = [name for name in _MOMENTS if getattr(self, name) is not None]
        if not 1 <= len(self.do) <= MAX_FAULTS_OF_CUE:
            raise ValueError(f"do: 1 to {MAX_FAULTS_OF_CUE} faults, got {len(self.do)}")
        if len(moments) > 1:
            raise ValueError(f"it happens at one moment, not by {' and '.join(moments)}")
        if self.every is not None and self.at is None:
            raise ValueError("every needs at: when it happens for the first time")
        if self.nth > 1 and self.entering is None and self.command is None:
            raise ValueError("nth needs entering or command; a fault has an nth of its own")
        if (self.times or 1) > 1 and self.every is None and moments in ([], ["at"]):
            raise ValueError("times needs every, entering or command")
        return self

    @property
    def is_random(self) -> bool:
        """True if the cue depends on chance."""
        return self.chance < 1 or self.spread > 0

    @property
    def limit(self) -> int | None:
        """Number of times that the cue applies, None: each time that its moment comes."""
        if self.times is None and (self.every is not None or self.command is not None):
            return None
        return self.times or 1


@dataclass(slots=True, eq=False)
class _CueState:
    """A cue and its counts."""

    cue: Cue
    random: Random  # the cue's random numbers, so that no cue changes another's
    moment_count: int = 0  # number of times that its moment came
    injected_count: int = 0  # number of times that its faults were injected

    @property
    def is_finished(self) -> bool:
        """True if no later moment matters."""
        limit = self.cue.limit
        return limit is not None and self.moment_count >= self.cue.nth - 1 + limit

    def count_moment(self) -> float | None:
        """Count a moment; return the seconds until the cue happens, None for never."""
        if self.is_finished:
            return None
        self.moment_count += 1
        if self.moment_count < self.cue.nth:
            return None
        happens = self.random.random() < self.cue.chance
        delay = self.cue.after + self.random.random() * self.cue.spread
        return delay if happens else None


class Timeline:
    """Runs cues; each start of the emulator makes a new timeline.

    Cues at the same instant happen in their order; all random numbers come from ``seed``.
    """

    def __init__(
        self,
        cues: Sequence[Cue],
        *,
        clock: Clock,
        seed: int,
        inject: Callable[[Sequence[Fault]], None],
    ) -> None:
        self._cue_states = [
            _CueState(cue, Random(f"{seed}/{number}"))  # noqa: S311  chance in a test, no secret
            for number, cue in enumerate(cues)
        ]
        self._state_cues = [row for row in self._cue_states if row.cue.entering is not None]
        self._clock = clock
        self._inject = inject
        self._pending: list[tuple[int, int, _CueState, bool]] = []
        self._order = itertools.count()
        self._timer = OneTimer(clock, self._run)
        self._due_cues: list[_CueState] = []
        self._is_running = False
        self._count_at_instant: tuple[float, int] = (0.0, 0)

    @property
    def watches_states(self) -> bool:
        """True if a cue waits for a state."""
        return bool(self._state_cues)

    @property
    def injected_counts(self) -> list[int]:
        """Number of times that each cue has happened."""
        return [row.injected_count for row in self._cue_states]

    def start(self) -> None:
        """Start the timeline: the present time is second 0."""
        begin = nanoseconds(self._clock.now)
        for row in self._cue_states:
            cue = row.cue
            if cue.at is not None:
                self._schedule(begin + nanoseconds(cue.at), row, is_moment=True)
            elif cue.entering is None and cue.command is None:
                self._handle_moment(row)
        self._run()

    def stop(self) -> None:
        """Drop the waiting cues. Harmless when called twice."""
        self._pending.clear()
        self._due_cues.clear()
        self._timer.set(None)

    def note_entered(self, state: DeviceState) -> None:
        """Note that the camera has entered a state."""
        for row in self._state_cues:
            if row.cue.entering is state:
                self._handle_moment(row)
        self._run()

    def command(self, name: str) -> None:
        """Give a command to the cues.

        Raises:
            ConfigurationError: no cue has it.
        """
        rows = [row for row in self._cue_states if row.cue.command == name]
        if not rows:
            known = sorted({row.cue.command for row in self._cue_states if row.cue.command})
            raise ConfigurationError(
                f"no cue of the timeline has the command {name!r}; there are "
                f"{', '.join(known) or 'none'}"
            )
        for row in rows:
            self._handle_moment(row)
        self._run()

    def _handle_moment(self, row: _CueState) -> None:
        """Count a moment of a cue, and run or schedule it."""
        delay = row.count_moment()
        if delay:
            self._schedule(nanoseconds(self._clock.now) + nanoseconds(delay), row, is_moment=False)
        elif delay is not None:
            self._due_cues.append(row)

    def _schedule(self, when: int, row: _CueState, *, is_moment: bool) -> None:
        if len(self._pending) >= MAX_PENDING:
            _log.warning("! timeline: more than %d cues wait, one is dropped", MAX_PENDING)
            return
        heapq.heappush(self._pending, (when, next(self._order), row, is_moment))

    def _run(self) -> None:
        """Run all cues that are due, one after the other, never inside another call."""
        if self._is_running:
            return
        self._is_running = True
        try:
            self._inject_due_cues()
            now = nanoseconds(self._clock.now)
            while self._pending and self._pending[0][0] <= now:
                when, _, row, is_moment = heapq.heappop(self._pending)
                if is_moment:
                    self._handle_moment(row)
                    if row.cue.every is not None and not row.is_finished:
                        self._schedule(when + nanoseconds(row.cue.every), row, is_moment=True)
                else:
                    self._due_cues.append(row)
                self._inject_due_cues()
        finally:
            self._is_running = False
        self._timer.set(self._pending[0][0] if self._pending else None)

    def _inject_due_cues(self) -> None:
        while self._due_cues:
            row = self._due_cues.pop(0)
            now, count = self._count_at_instant
            self._count_at_instant = (
                (now, count + 1) if now == self._clock.now else (self._clock.now, 1)
            )
            if self._count_at_instant[1] > MAX_CUES_AT_ONCE:
                _log.warning(
                    "! timeline: more than %d cues at once, one is dropped", MAX_CUES_AT_ONCE
                )
                continue
            row.injected_count += 1
            try:
                self._inject(row.cue.do)
            except ConfigurationError as exc:  # too many faults wait
                _log.warning("! timeline: not injected: %s", exc)
