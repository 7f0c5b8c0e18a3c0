"""The emulated Keyence IV3 sensor."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

from smartcam._arguments import check_integer, check_seconds
from smartcam.emulator import LineCamera
from smartcam.exceptions import ConfigurationError
from smartcam.makes._keyence.iv3 import IV3, LAST_PROGRAM

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from smartcam.emulator import LineClient

LAST_COUNT = 32_767
"""The largest count of triggers; the next one is 1."""


class Iv3Device:
    """The operator of an emulated camera: what is done at the device itself."""

    def __init__(self, camera: EmulatedIv3) -> None:
        self._camera = camera

    def trigger(self) -> None:
        """Trigger at the input; nobody is told of its result."""
        self._camera.judge()

    def switch_application(self, application: int, running: bool = False) -> None:
        """Make another program the active one."""
        self._camera.active = application


class EmulatedIv3(LineCamera):
    """An emulated IV3 that judges the same parts over and over.

    Args:
        programs: numbers of its programs, 0 to 127.
        active: number of the active one; None for the first one.
        parts: the rates of the tools of each part, of which 70 and more is OK.
        processing_time: seconds of an inspection.
        options: the options of :class:`~smartcam.emulator.LineCamera`.

    Raises:
        ConfigurationError: something given is wrong.
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
        self.programs: list[int] = [
            check_integer(one, "programs", 0, LAST_PROGRAM) for one in programs
        ]
        self.active: int = self.programs[0] if active is None else active
        if self.active not in self.programs:
            raise ConfigurationError(f"active: one of {self.programs} was expected, got {active!r}")
        self.parts: itertools.cycle[Sequence[int]] = itertools.cycle(tuple(parts) or ((),))
        self.processing_time: float = check_seconds(processing_time, "processing_time")
        self.count: int = 0
        self.last: str = "RT,00000,NG"
        self.device: Any = Iv3Device(self)
        super().__init__(**options)

    @classmethod
    def state_options(cls, active: int | None, *, running: bool) -> dict[str, Any]:
        """Return the options with which a program is active."""
        return {"active": active}

    @property
    def application_ids(self) -> list[int]:
        """Numbers of its programs."""
        return list(self.programs)

    def judge(self) -> str:
        """Inspect the next part; return the result as a line."""
        self.count = self.count % LAST_COUNT + 1
        rates = [check_integer(rate, "a rate", 0, 9_999_999) for rate in next(self.parts)]
        tools = [
            f"{tool:02},{'OK' if rate >= 70 else 'NG'},{rate:07}"
            for tool, rate in enumerate(rates, 1)
        ]
        judged = "OK" if all(rate >= 70 for rate in rates) else "NG"
        self.last = ",".join([f"RT,{self.count:05},{judged}", *tools])
        return self.last

    def hear(self, client: LineClient, line: str) -> None:
        """Answer a line; a trigger when its inspection is over, and no other line before it."""
        if line == "T2":
            self.after(self.processing_time, lambda: client.answer(self.judge()))
        else:
            client.answer(self.answer(line))

    def answer(self, line: str) -> str:
        """Return the answer to another line than a trigger with a result."""
        word, _, rest = line.partition(",")
        if line == "T1":
            self.judge()
            return "T1"
        if line == "RT":
            return self.last
        if line == "PR":
            return f"PR,{self.active:03}"
        if word != "PW":
            return f"ER,{word},02"
        if not rest.isdecimal() or int(rest[:9]) not in self.programs:
            return "ER,PW,22"
        self.active = int(rest)
        return "PW"
