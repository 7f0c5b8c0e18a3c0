"""Emulated cameras for the camera suite, in a thread: documented ones, and ones that sin."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from types import MappingProxyType
from typing import Any, NamedTuple

from smartcam._loop_thread import LoopThread
from smartcam.conformance.camera import Allow, ConformanceOptions, judge
from smartcam.emulator import EmulatedCamera
from tests.conformance.inside import CameraReport
from tests.conformance.pace import is_first, slowed

APPLICATION, OTHER = 5, 6

APPLICATIONS = (
    {
        "id": APPLICATION,
        "layout": "n: int32 @sequence, v: int32",
        "constant": {"v": 3},
        "input": "v: int32",
        "load_time": 0.06,
        "processing_time": 0.04,
    },
    {
        "id": OTHER,
        "layout": "t: string[4]",
        "constant": {"t": "ab"},
        "load_time": 0.06,
        "processing_time": 0.04,
    },
)
"""One with a sequence number and input data, and another one."""

WORLDS = [
    (dialect, transport)
    for dialect in ("handbook", "thesis", "b16", "bid")
    for transport in ("tcp", "udp")
]

AT_ONCE = 16
"""Cameras judged at the same time: each waits nearly always."""


class Case(NamedTuple):
    """A camera, and what it is judged by."""

    camera: dict[str, Any]  # options of the emulator
    items: tuple[str, ...] | None = None  # names of checks and questions, None for all
    sin: Callable[[Any], None] | None = None  # what is done to the emulator first
    options: Mapping[str, Any] = MappingProxyType({})  # fields of the options


def short_options(url: str, **fields: Any) -> ConformanceOptions:
    """Return a options with everything allowed and short times."""
    given: dict[str, Any] = {
        "other_application": OTHER,
        "allow": ~Allow.NOTHING,
        "silence": 0.1,
        "timeout": 2.0,
        "switch_timeout": 1.0,
        "reboot_timeout": 5.0,
        "sequence_offset": 0,
        "input_data": bytes(4),
    }
    return ConformanceOptions(url=url, **_slowed({**given, **fields}))


SECONDS = {
    *("silence", "timeout", "switch_timeout", "reboot_timeout"),
    *("load_time", "processing_time", "overtriggered_time", "reboot_time"),
}
"""Settings in seconds, of options, an application and a camera's quirks."""


def _slowed(fields: Mapping[str, Any]) -> dict[str, Any]:
    return {name: slowed(one) if name in SECONDS else one for name, one in fields.items()}


@contextlib.contextmanager
def loop_thread() -> Iterator[LoopThread]:
    """Give an event loop in a thread; it ends all cameras that live in it."""
    thread = LoopThread("conformance")
    thread.start()
    try:
        yield thread
    finally:
        thread.stop()


@contextlib.contextmanager
def emulated(
    thread: LoopThread, sin: Callable[[Any], None] | None = None, **options: Any
) -> Iterator[EmulatedCamera]:
    """Run an emulated camera with short times in a thread."""
    given = {"applications": APPLICATIONS, **options}
    given["applications"] = [_slowed(one) for one in given["applications"]]
    given["quirks"] = _slowed(given.get("quirks", {}))
    emulator = EmulatedCamera(**given)
    if sin is not None:
        sin(emulator)
    thread.run_coroutine(emulator.start)
    try:
        yield emulator
    finally:
        thread.run_coroutine(emulator.stop)


def judge_case(thread: LoopThread, case: Case) -> CameraReport:
    with emulated(thread, case.sin, **case.camera) as emulator:
        return judge(short_options(emulator.url, **case.options), case.items)


def judge_all(cases: Iterable[Case]) -> list[CameraReport]:
    """Judge cameras, several at the same time."""
    with loop_thread() as thread, ThreadPoolExecutor(AT_ONCE) as pool:
        return list(pool.map(lambda case: judge_case(thread, case), cases))


class Judged:
    """The reports of cases: of all together, and at a slower pace of each that is asked for."""

    def __init__(self, cases: list[Case]) -> None:
        self._cases = cases
        self._reports = judge_all(cases)

    def __getitem__(self, number: int) -> CameraReport:
        if is_first():
            return self._reports[number]
        (report,) = judge_all([self._cases[number]])
        return report
