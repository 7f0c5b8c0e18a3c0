"""The emulated Keyence SR reader."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, Any

from smartcam._arguments import check_flag, check_seconds
from smartcam.emulator import LineCamera
from smartcam.makes._keyence.sr import LAST_BANK, LINES, NOTHING_READ, SR

if TYPE_CHECKING:
    from collections.abc import Iterable

    from smartcam.emulator import LineClient


class SrDevice:
    """Actions at the emulated reader itself, as by an operator."""

    def __init__(self, camera: EmulatedSr) -> None:
        self._camera = camera

    def trigger(self) -> None:
        """Trigger by the reader's trigger input; the reading is sent to all clients."""
        self._camera.tell_all()


class EmulatedSr(LineCamera):
    """An emulated SR reader that reads the same codes again and again.

    Args:
        codes: the code of each reading; None for a code that cannot be read.
        reading_time: seconds from LON until a code is read.
        answer_time: seconds from the reading's end until its line is sent.
        waits_for_end: whether the reading is sent at LOFF instead of when the code is read.
        options: the options of :class:`~smartcam.emulator.LineCamera`.

    Raises:
        ConfigurationError: an argument is wrong.
    """

    protocol = SR

    def __init__(
        self,
        *,
        codes: Iterable[str | None] = ("4006381333931", "4012345678901"),
        reading_time: float = 0.02,
        answer_time: float = 0.0,
        waits_for_end: bool = False,
        **options: Any,
    ) -> None:
        self.codes: itertools.cycle[str | None] = itertools.cycle(tuple(codes) or (None,))
        self.reading_time: float = check_seconds(reading_time, "reading_time")
        self.answer_time: float = check_seconds(answer_time, "answer_time")
        self.waits_for_end: bool = check_flag(waits_for_end, "waits_for_end")
        self.read_count: int = 0
        self.unread_count: int = 0
        self._reading: LineClient | None = None
        self._code: str | None = None  # code that was read in the current reading
        self._reading_number = 0
        self.device: Any = SrDevice(self)
        super().__init__(**options)

    def hear(self, client: LineClient, line: str) -> None:
        """Answer a line; a reading's result is sent later, and other lines are answered before."""
        call = client.answer_later()
        word, _, argument = line.partition(",")
        is_bank = argument.isdecimal() and len(argument) == 2 and int(argument) <= LAST_BANK
        if line == "LON" or (word == "LON" and is_bank):
            self._begin(call)
        elif line == "LOFF":
            self._end()
        else:
            call.answer(self.answer(line))

    def answer(self, line: str) -> str:
        """Return the answer to a line that neither begins nor ends a reading."""
        word = line.partition(",")[0]
        answers = {
            "BUSYSTAT": f"OK,BUSYSTAT,{'NONE' if self._reading is None else 'TRG'}",
            "ERRSTAT": "OK,ERRSTAT,NONE",
            "NUM": f"OK,NUM,{self.read_count},{self.unread_count}",
            "BCLR": "OK,BCLR",
            "RESET": "OK,RESET",
        }
        return answers.get(line, f"ER,{word},{'02' if word == 'LON' else '00'}")

    def _before_stop(self) -> None:
        """Forget the current reading, like a reader that loses power."""
        super()._before_stop()
        self._reading, self._code, self._reading_number = None, None, self._reading_number + 1

    def _begin(self, call: LineClient) -> None:
        if self._reading is not None:
            call.answer("ER,LON,20")
            return
        self._reading, self._code, self._reading_number = call, None, self._reading_number + 1
        number = self._reading_number
        self.after(self.reading_time, lambda: self._read_code(number))

    def _read_code(self, number: int) -> None:
        """Read the next code if the reading with this number still runs."""
        if number != self._reading_number or self._reading is None:
            return
        self._code = next(self.codes)
        if self._code is not None and not self.waits_for_end:
            self._send_reading()

    def _end(self) -> None:
        if self._reading is not None:
            self._send_reading()

    def _send_reading(self) -> None:
        call, code = self._reading, self._code
        self._reading = self._code = None
        self.read_count += code is not None
        self.unread_count += code is None
        if call is not None:
            text = NOTHING_READ if code is None else code
            self.after(self.answer_time, lambda: call.answer(text))

    def tell_all(self) -> None:
        """Read a code and send it to all clients."""
        code = next(self.codes)
        row_number = next(number for number, row in enumerate(LINES.rows, 1) if row.line == "code")
        for client in list(self._clients.values()):
            client.say_bytes(
                self.lines.data(NOTHING_READ if code is None else code), row=row_number
            )
