"""The hooks of observers, their order, and what becomes of one that fails."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Any

import pytest

import smartcam
from smartcam import ConfigurationError, Connected, Observer, Result, SmartCamError
from smartcam.observers import Observers, RawFrame, TraceEntry
from smartcam.protocols import BVS, Frame
from smartcam.protocols.messages import Sender

AT = datetime(2024, 5, 1, tzinfo=UTC)
DIALECT = BVS.dialects["handbook"]
RAW = RawFrame(AT, "press 4", DIALECT, Sender.CLIENT, Frame(0x40, b""))
FRAME = RAW.entry()
EVENT = Connected(camera="press 4", at=AT, url="bvs://127.0.0.1:1")
RESULT = Result("press 4", 7, None, 1, None, AT, None, b"", b"")
ERROR = SmartCamError("no result")


class Everything(Observer):
    """Notes every call."""

    def __init__(self, name: str, calls: list[tuple[Any, ...]]) -> None:
        self.name = name
        self.calls = calls

    def on_frame(self, entry: TraceEntry) -> None:
        self.calls.append((self.name, "frame", entry))

    def on_state(self, event: smartcam.CameraEvent) -> None:
        self.calls.append((self.name, "state", event))

    def on_result(self, result: Result) -> None:
        self.calls.append((self.name, "result", result))

    def on_error(self, camera: str, error: SmartCamError, triggered_at: datetime | None) -> None:
        self.calls.append((self.name, "error", camera, error, triggered_at))


class Broken(Everything):
    """Raises at every call, after it has noted it."""

    def _fail(self) -> None:
        raise RuntimeError("the observer's own")

    def on_frame(self, entry: TraceEntry) -> None:
        super().on_frame(entry)
        self._fail()

    def on_state(self, event: smartcam.CameraEvent) -> None:
        super().on_state(event)
        self._fail()

    def on_result(self, result: Result) -> None:
        super().on_result(result)
        self._fail()

    def on_error(self, camera: str, error: SmartCamError, triggered_at: datetime | None) -> None:
        super().on_error(camera, error, triggered_at)
        self._fail()


class Blind(Observer):
    """Overrides nothing."""


def _frame(observers: Observers) -> None:
    trace = observers.trace
    assert trace is not None
    trace((RAW,))


HOOKS: dict[str, tuple[Callable[[Observers], None], tuple[Any, ...]]] = {
    "frame": (_frame, (FRAME,)),
    "state": (lambda observers: observers.state(EVENT), (EVENT,)),
    "result": (lambda observers: observers.result(RESULT), (RESULT,)),
    "error": (lambda observers: observers.error("press 4", ERROR, AT), ("press 4", ERROR, AT)),
}
EACH = pytest.mark.parametrize("hook", HOOKS)


@EACH
def test_hook_gets_what_it_is_told(hook: str) -> None:
    calls: list[tuple[Any, ...]] = []
    call, arguments = HOOKS[hook]
    call(Observers([Everything("one", calls)]))
    assert calls == [("one", hook, *arguments)]


@EACH
def test_hooks_are_called_in_the_order_given(hook: str) -> None:
    calls: list[tuple[Any, ...]] = []
    HOOKS[hook][0](Observers(Everything(name, calls) for name in ("one", "two", "three")))
    assert [call[0] for call in calls] == ["one", "two", "three"]


@EACH
def test_observer_that_raises_is_logged_and_the_rest_are_called(
    hook: str, caplog: pytest.LogCaptureFixture
) -> None:
    calls: list[tuple[Any, ...]] = []
    HOOKS[hook][0](
        Observers([Everything("one", calls), Broken("two", calls), Everything("three", calls)])
    )
    assert [call[0] for call in calls] == ["one", "two", "three"]
    (record,) = caplog.records
    assert (record.name, record.levelno) == ("smartcam.client", logging.ERROR)
    assert "an observer failed" in record.getMessage()
    assert f"on_{hook}" in record.getMessage()
    assert record.exc_info is not None
    assert str(record.exc_info[1]) == "the observer's own"


@EACH
def test_observer_that_overrides_nothing_does_nothing(hook: str) -> None:
    call = HOOKS[hook][0]
    if hook == "frame":
        assert Observers([Blind()]).trace is None
    else:
        call(Observers([Blind()]))


def test_error_that_is_no_triggers_has_no_time() -> None:
    calls: list[tuple[Any, ...]] = []
    Observers([Everything("one", calls)]).error("press 4", ERROR)
    assert calls == [("one", "error", "press 4", ERROR, None)]


def test_frames_are_not_asked_for_if_nobody_looks() -> None:
    assert Observers().trace is None
    assert Observers([Blind(), Observer()]).trace is None


def test_frames_go_only_to_observers_that_look() -> None:
    calls: list[tuple[Any, ...]] = []
    looking: list[Observer] = [Blind(), Everything("one", calls), Blind()]
    trace = Observers(looking).trace
    assert trace is not None
    trace((RAW,))
    assert calls == [("one", "frame", FRAME)]


def test_frames_go_to_an_observer_that_inherits_the_hook() -> None:
    class Heir(Everything):
        pass

    assert Observers([Heir("heir", [])]).trace is not None


class Raw(Everything):
    """Takes frames before they are decoded, and would note it if it were given one decoded."""

    def on_raw_frame(self, frame: RawFrame) -> None:
        self.calls.append((self.name, "raw", frame))


def test_frame_goes_undecoded_to_who_takes_it_so_and_decoded_to_others() -> None:
    calls: list[tuple[Any, ...]] = []
    trace = Observers([Raw("one", calls), Everything("two", calls), Blind()]).trace
    assert trace is not None
    trace((RAW,))
    assert calls == [("one", "raw", RAW), ("two", "frame", FRAME)]
    assert (FRAME.direction, FRAME.message, FRAME.message_id) == (">", "Trigger", 0x40)


class RawTogether(Raw):
    """Takes frames together, and would note it if it were given one alone."""

    def on_raw_frames(self, frames: Sequence[RawFrame]) -> None:
        self.calls.append((self.name, "together", *frames))


class DecodedAgain(RawTogether):
    """Overrides the first hook last."""

    def on_frame(self, entry: TraceEntry) -> None:
        self.calls.append((self.name, "frame", entry))


def test_frames_come_together_if_nobody_wants_them_one_by_one() -> None:
    calls: list[tuple[Any, ...]] = []
    other = RAW._replace(camera="press 5")
    for together in (True, False):
        more = [] if together else [Raw("three", calls), DecodedAgain("four", calls)]
        observers = [RawTogether("one", calls), Blind(), RawTogether("two", calls), *more]
        trace = Observers(observers).trace
        assert trace is not None
        trace([RAW, other])
        expected: list[tuple[Any, ...]] = [
            (name, "together", RAW, other) for name in ("one", "two")
        ]
        if not together:
            expected = [
                call
                for one in (RAW, other)
                for call in (
                    ("one", "together", one),
                    ("two", "together", one),
                    ("three", "raw", one),
                    ("four", "frame", one.entry()),
                )
            ]
        assert calls == expected
        calls.clear()
    RawTogether("one", calls).on_raw_frame(RAW)
    Raw("two", calls).on_raw_frames([RAW, other])
    assert calls == [("one", "raw", RAW), ("two", "raw", RAW), ("two", "raw", other)]


def test_raw_frame_that_is_not_taken_goes_to_the_other_hook() -> None:
    calls: list[tuple[Any, ...]] = []
    Everything("one", calls).on_raw_frame(RAW)
    broken = TraceEntry(AT, "press 4", "!", None, "no frame", None, "0011")
    Everything("one", calls).on_raw_frame(RawFrame(AT, "press 4", DIALECT, Sender.CAMERA, broken))
    assert calls == [("one", "frame", FRAME), ("one", "frame", broken)]
    assert RawFrame(AT, "press 4", DIALECT, Sender.CAMERA, broken).size == 2


def test_results_and_events_are_asked_for_if_somebody_looks() -> None:
    class Looks(Observer):
        def on_result(self, result: Result) -> None: ...

    one, other = Observers([Blind(), Looks()]), Observers([Blind(), Everything("one", [])])
    assert (one.handles_results, one.handles_states) == (True, False)
    assert (other.handles_results, other.handles_states) == (True, True)
    neither = Observers([Blind()])
    assert (neither.handles_results, neither.handles_states) == (False, False)


def test_observer_with_a_hook_of_its_own_object_is_called() -> None:
    seen: list[Result] = []
    blind = Blind()
    setattr(blind, "on_result", seen.append)  # noqa: B010 - a type checker would refuse it
    Observers([blind]).result(RESULT)
    assert seen == [RESULT]


OTHERS = [RESULT._replace(number=number) for number in (2, 3)]


class Together(Everything):
    """Takes results together, and would note it if it were given one alone."""

    def on_results(self, results: Sequence[Result]) -> None:
        self.calls.append((self.name, "results", *results))


def test_results_come_together_if_nobody_wants_them_one_by_one() -> None:
    calls: list[tuple[Any, ...]] = []
    observers = Observers([Together("one", calls), Blind(), Together("two", calls)])
    assert (observers.handles_results, observers.handles_single_results) == (True, False)
    observers.results(OTHERS)
    observers.result(RESULT)
    assert calls == [
        *((name, "results", *OTHERS) for name in ("one", "two")),
        *((name, "results", RESULT) for name in ("one", "two")),
    ]


def test_results_come_one_by_one_to_all_where_one_wants_that() -> None:
    calls: list[tuple[Any, ...]] = []
    observers = Observers([Together("one", calls), Everything("two", calls)])
    assert observers.handles_single_results
    observers.results(OTHERS)
    assert calls == [
        (name, what, one)
        for one in OTHERS
        for name, what in (("one", "results"), ("two", "result"))
    ]


def test_observer_that_raises_at_one_result_is_given_the_next(
    caplog: pytest.LogCaptureFixture,
) -> None:
    calls: list[tuple[Any, ...]] = []
    observers = Observers([Broken("one", calls), Everything("two", calls)])
    assert [*observers.each(OTHERS)] == OTHERS
    assert calls == [(name, "result", one) for one in OTHERS for name in ("one", "two")]
    assert len(caplog.records) == len(OTHERS)


def test_results_that_are_not_overridden_go_to_the_other_hook() -> None:
    calls: list[tuple[Any, ...]] = []
    Everything("one", calls).on_results(OTHERS)
    assert calls == [("one", "result", one) for one in OTHERS]


def test_object_without_the_hook_for_several_results_is_an_observer() -> None:
    seen: list[Result] = []

    class Plain:
        on_frame = on_state = on_picture = on_error = print
        on_result = staticmethod(seen.append)

    given: Any = [Plain()]
    Observers(given).results(OTHERS)
    assert seen == OTHERS


def test_observers_given_as_a_generator_are_kept() -> None:
    calls: list[tuple[Any, ...]] = []
    observers = Observers(Everything("one", calls) for _ in range(1))
    for _ in range(2):
        observers.result(RESULT)
    assert len(calls) == 2


def test_exit_is_not_held_up_by_an_observer() -> None:
    class Quitter(Observer):
        def on_result(self, result: Result) -> None:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Observers([Quitter()]).result(RESULT)


@pytest.mark.parametrize("wrong", [Observer, object(), 5])
def test_what_is_no_observer_is_refused(wrong: object) -> None:
    with pytest.raises(ConfigurationError, match="observers: expected objects of classes of Obs"):
        Observers([wrong])  # type: ignore[list-item]
