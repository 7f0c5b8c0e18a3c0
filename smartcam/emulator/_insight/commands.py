"""Carry out command lines on the emulated In-Sight device, and make the answers."""

from __future__ import annotations

import asyncio
import logging
import re
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

from pydantic import Field

from smartcam.emulator._data import EmulatorData
from smartcam.emulator._insight.image import bitmap, check_image
from smartcam.exceptions import ConfigurationError
from smartcam.protocols._inside import StatusCode, words

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import numpy as np
    from numpy.typing import NDArray

    from smartcam.emulator._insight.device import InSightDevice

_log = logging.getLogger("smartcam.emulator")


class InSightQuirks(EmulatorData):
    """Choices for unknown behaviour of real cameras."""

    event_answer: Literal["code", "sized"] = Field(
        default="code",
        description=(
            "what answers SE: the code alone, or the code, a length and a text as for EV, which "
            "CognexNativePy 1.0.12 expects"
        ),
    )
    image_size: Literal["digits", "bytes"] = Field(
        default="digits",
        description=(
            "what the size line of RI and RB counts: hexadecimal digits, as published for RJ and "
            "RS, or bytes of the bitmap file"
        ),
    )
    transfer_pause: float = Field(
        default=0.0,
        ge=0,
        le=60,
        allow_inf_nan=False,
        description="seconds between the size line of an image and its data",
    )


class Respond(Protocol):
    """A function that sends the answer to a command."""

    def __call__(self, data: bytes, *, more: bool = False) -> None:
        """Send bytes; with ``more``, another call sends the remaining bytes."""


class InSightCommands:
    """Carries out a camera's commands; the arguments are as for ``EmulatedInSight``.

    Raises:
        ConfigurationError: an argument is wrong.
    """

    def __init__(
        self,
        device: InSightDevice,
        *,
        evaluations: Mapping[str, str] | None = None,
        info: Mapping[str, str] | None = None,
        quirks: InSightQuirks | None = None,
    ) -> None:
        self.quirks: InSightQuirks = InSightQuirks() if quirks is None else quirks
        self._device = device
        self._evaluations = dict(evaluations or {})
        self._info = {**_INFO, **(info or {})}
        if len(self._info) != len(_INFO):
            raise ConfigurationError(f"info: known are {', '.join(_INFO)}")
        for option, texts in (("info", self._info), ("evaluations", self._evaluations)):
            for name, text in texts.items():
                _check_sendable(f"{option}: {name}", text)
        self._immediate_commands: Mapping[str, Callable[[str], bytes]] = {
            "GO": lambda _: _line(str(int(device.online))),
            "SO": self._set_online,
            "GF": lambda _: _value_answer(None if device.job is None else device.job.file),
            "GJ": lambda _: _value_answer(None if device.job is None else device.job.id),
            "GV": self._get_value,
            "SI": lambda argument: self._set_value(argument, "int", _parse_integer),
            "SF": lambda argument: self._set_value(argument, "float", _parse_number),
            "SS": lambda argument: self._set_value(argument, "string", str),
            "GI": self._get_info,
            "EV": self._evaluate,
        }
        self._timed_commands: Mapping[str, Callable[[str, Respond], None]] = {
            "SE": self._set_event,
            "SW": self._set_event_and_wait,
            "LF": lambda argument, respond: self._load(argument or None, respond),
            "SJ": self._set_job,
            "RI": self._read_image,
            "RB": self._read_image,
        }

    def execute(self, line: str, respond: Respond) -> None:
        """Carry out a line without its end; the answer comes at once or in the device's time."""
        mnemonic, argument = line[:2].upper(), line[2:]
        row = words.COMMANDS.get(mnemonic)
        if row is None or (argument and not row.arguments):
            respond(_code_answer(StatusCode.UNRECOGNIZED))
        elif mnemonic in self._immediate_commands:
            respond(self._immediate_commands[mnemonic](argument))
        else:
            self._timed_commands[mnemonic](argument, respond)

    # ------------------------------------------------------------------ mode and events

    def _set_online(self, argument: str) -> bytes:
        if argument not in {"0", "1"}:
            return _code_answer(StatusCode.INVALID_ARGUMENT)
        return _code_answer(self._device.request_online(argument == "1"))

    def _set_event(self, argument: str, respond: Respond) -> None:
        def report_code(code: StatusCode) -> None:
            is_sized = code == StatusCode.DONE and self.quirks.event_answer == "sized"
            respond(_sized_answer("") if is_sized else _code_answer(code))

        self._request_event(argument, report_code, after_image=True)

    def _set_event_and_wait(self, argument: str, respond: Respond) -> None:
        self._request_event(argument, lambda code: respond(_code_answer(code)), after_image=False)

    def _request_event(
        self, argument: str, report_code: Callable[[StatusCode], None], *, after_image: bool
    ) -> None:
        event = _parse_integer(argument)
        if event is None or not 0 <= event <= words.TRIGGER_EVENT:
            report_code(StatusCode.INVALID_ARGUMENT)
        else:
            self._device.request_event(event, report_code, after_image=after_image)

    # ------------------------------------------------------------------ jobs

    def _set_job(self, argument: str, respond: Respond) -> None:
        number = _parse_integer(argument)
        self._load(None if number is None or number < 0 else number, respond)

    def _load(self, job: str | int | None, respond: Respond) -> None:
        if job is None:
            respond(_code_answer(StatusCode.INVALID_ARGUMENT))
        else:
            self._device.request_job(job, lambda code: respond(_code_answer(code)))

    # ------------------------------------------------------------------ cells

    def _get_value(self, argument: str) -> bytes:
        cell = words.parse_wire_cell(argument)
        key = self._key_of_name(argument) if cell is None else cell[0].wire
        if key is None or (cell is not None and cell[1]):
            return _code_answer(StatusCode.INVALID_ARGUMENT)
        return _value_answer(self._device.cells.get(key))

    def _set_value(
        self, argument: str, kind: str, read: Callable[[str], int | float | str | None]
    ) -> bytes:
        key, text = self._cell_to_set(argument)
        value = read(text)
        if key is None or value is None:
            return _code_answer(StatusCode.INVALID_ARGUMENT)
        return _code_answer(self._device.request_value(key, kind, value))

    def _cell_to_set(self, argument: str) -> tuple[str | None, str]:
        """Return the key of the cell to set (None: no such cell), and the text after the cell."""
        cell = words.parse_wire_cell(argument)
        if cell is not None:
            return cell[0].wire, cell[1]
        name, _, text = argument.partition(" ")
        return self._key_of_name(name), text

    def _key_of_name(self, name: str) -> str | None:
        """Return the key of a cell with a name, None if there is no such cell.

        The keys of names are in lower case, those of positions are not (``A001``), so a position is
        never found here.
        """
        key, job = name.lower(), self._device.job
        return key if job is not None and key in job.sources else None

    # ------------------------------------------------------------------ the rest

    def _get_info(self, _argument: str) -> bytes:
        lines = (_line(f"{name}: {value}") for name, value in self._info.items())
        return _code_answer(StatusCode.DONE) + b"".join(lines)

    def _evaluate(self, argument: str) -> bytes:
        text = self._evaluations.get(argument.strip())
        return _code_answer(StatusCode.FAILED) if text is None else _sized_answer(text)

    def _read_image(self, _argument: str, respond: Respond) -> None:
        device = self._device
        if device.get_last_image is None:
            self._send_image(coded_image(device.image), respond)
            return
        # a sensor's image is large: it is written in a thread
        writing_future = asyncio.get_running_loop().run_in_executor(
            None, _last_image, device.get_last_image
        )

        def on_written(future: asyncio.Future[CodedImage | None]) -> None:
            if not future.cancelled():
                with device.action_context():
                    self._send_image(future.result(), respond)

        writing_future.add_done_callback(on_written)

    def _send_image(self, image: CodedImage | None, respond: Respond) -> None:
        if image is None:
            respond(_code_answer(StatusCode.FAILED))
            return
        digits = self.quirks.image_size == "digits"
        respond(_value_answer(image.digits if digits else image.size), more=True)
        self._device.after(self.quirks.transfer_pause, lambda: respond(image.lines))


class CodedImage(NamedTuple):
    """An image as lines of hexadecimal digits.

    Attributes:
        size: bytes of the bitmap file.
        digits: hexadecimal digits.
        lines: the lines, with their ends.
    """

    size: int
    digits: int
    lines: bytes


def coded_image(image: NDArray[np.uint8]) -> CodedImage:
    """Return an image as the camera sends it."""
    data = bitmap(image)
    return CodedImage(len(data), *words.hex_lines(data))


def _last_image(read_image: Callable[[], Any]) -> CodedImage | None:
    """Return the image of the last run; None if the camera could not have taken it."""
    try:
        return coded_image(check_image(read_image()))
    except ConfigurationError as exc:
        _log.warning("! no image is sent: %s", exc)
        return None


_INFO = {
    "Serial Number": "100000001",
    "Application Version": "6.1.0",
    "Monitor Version": "6.1.0",
    "MAC Address": "00-D0-24-00-00-01",
    "Date of Build": "Jan 01 2020",
}
"""The names stand in a public client's tests (derived); the values are the emulator's."""

_INTEGER = re.compile(r"[+-]?[0-9]{1,10}")
_NUMBER = re.compile(r"[+-]?([0-9]{1,20}(\.[0-9]{0,20})?|\.[0-9]{1,20})([eE][+-]?[0-9]{1,2})?")


def image_answer(image: NDArray[np.uint8]) -> bytes:
    """Return the whole answer to ``RI`` for a picture, (H, W)."""
    digits, lines = words.hex_lines(bitmap(image))
    return _value_answer(digits) + lines


def _line(text: str) -> bytes:
    return text.encode(words.ENCODING) + words.LINE_END


def _code_answer(code: StatusCode) -> bytes:
    return _line(str(int(code)))


def _value_answer(value: str | int | None) -> bytes:
    """Return the answer with a value; None: not possible."""
    if value is None:
        return _code_answer(StatusCode.FAILED)
    return _code_answer(StatusCode.DONE) + _line(str(value))


def _sized_answer(text: str) -> bytes:
    return _value_answer(len(text)) + _line(text)


def _check_sendable(where: str, text: str) -> None:
    try:
        text.encode(words.ENCODING)
    except UnicodeEncodeError as exc:
        raise ConfigurationError(f"{where}: only Latin-1 can be sent, got {text!r:.80}") from exc


def _parse_integer(text: str) -> int | None:
    return int(text) if _INTEGER.fullmatch(text) else None


def _parse_number(text: str) -> float | None:
    return float(text) if _NUMBER.fullmatch(text) else None
