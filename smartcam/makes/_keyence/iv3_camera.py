"""The emulated Keyence IV3 sensor."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam._arguments import check_integer, check_seconds
from smartcam.emulator._inside import EvaluatingCamera, request
from smartcam.makes._keyence.iv3 import IV3, LAST_PROGRAM

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from smartcam.emulator import LineClient

MAX_COUNT = 32_767
"""Largest count of triggers; the count after it is 1."""

MIN_OK_RATE = 70
"""Smallest rate that a tool judges as OK."""


class EmulatedIv3(EvaluatingCamera):
    """An emulated IV3 that judges the same parts again and again.

    Args:
        programs: numbers of its programs, 0 to 127.
        active: number of the active program; None for the first one.
        parts: rates of the tools for each part; a rate of 70 or more is OK.
        processing_time: seconds of an inspection.
        options: the options of :class:`~smartcam.emulator.LineCamera`.

    Raises:
        ConfigurationError: an argument is wrong.
    """

    protocol = IV3

    def __init__(
        self,
        *,
        programs: Iterable[int] = (0, 1),
        active: int | None = None,
        parts: Iterable[Sequence[int]] = ((95, 88), (95, 12)),
        processing_time: float = 0.01,
        **options: Any,
    ) -> None:
        given_parts = tuple(parts) or ((),)
        numbers = [check_integer(program, "programs", 0, LAST_PROGRAM) for program in programs]
        self.set_up(dict.fromkeys(numbers, given_parts), active)
        self.processing_time: float = check_seconds(processing_time, "processing_time")
        self.count: int = 0
        self.last: str = "RT,00000,NG"
        super().__init__(**options)

    @property
    def evaluation_time(self) -> float:
        """Seconds of an inspection."""
        return self.processing_time

    def report_evaluation(self, call: LineClient | None, part: Sequence[int]) -> None:
        """Judge a part; send the result to the client that asked for it."""
        self.count = self.count % MAX_COUNT + 1
        rates = [check_integer(rate, "a rate", 0, 9_999_999) for rate in part]
        tools = [
            f"{tool:02},{'OK' if rate >= MIN_OK_RATE else 'NG'},{rate:07}"
            for tool, rate in enumerate(rates, 1)
        ]
        judgement = "OK" if all(rate >= MIN_OK_RATE for rate in rates) else "NG"
        self.last = ",".join([f"RT,{self.count:05},{judgement}", *tools])
        if call is not None:
            call.answer(self.last)

    def voided(self, call: LineClient) -> None:
        """Refuse a trigger that is interrupted by a switch at the sensor."""
        call.answer("ER,T2,03")

    def unknown(self, line: str) -> str:
        """Return the answer to an unknown command."""
        return f"ER,{line.partition(',')[0]},02"

    @request("T2")
    def _trigger(self, client: LineClient) -> str | None:
        """Inspect, and answer with the result."""
        if self.busy:
            return "ER,T2,03"
        self.begin_evaluation(client)
        return None

    @request("T1")
    def _trigger_without_answer(self, client: LineClient) -> str:
        """Inspect without answering with the result, which the client asks for later."""
        if self.busy:
            return "ER,T1,03"
        self.begin_evaluation(None)
        return "T1"

    @request("RT")
    def _result(self, client: LineClient) -> str:
        """Return the last result."""
        return self.last

    @request("PR")
    def _program(self, client: LineClient) -> str:
        """Return the active program."""
        return f"PR,{self.active:03}"

    @request("PW(?:,(.*))?")
    def _switch(self, client: LineClient, number: str | None) -> str:
        """Make another program the active one."""
        text = number or ""
        if not (text.isascii() and text.isdecimal()) or int(text[:9]) not in self.application_ids:
            return "ER,PW,22"
        self.activate(int(text[:9]))
        return "PW"
