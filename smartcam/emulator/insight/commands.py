"""What the emulated In-Sight camera answers to a line, to the byte."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, ClassVar, Literal, Protocol

from pydantic import BaseModel, ConfigDict, Field

from smartcam.emulator.insight.image import bitmap
from smartcam.exceptions import ConfigurationError
from smartcam.protocols.insight import words
from smartcam.protocols.insight.words import StatusCode

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from smartcam.emulator.insight.device import InSightDevice

__all__ = ["Answer", "Commands", "InSightQuirks"]


class InSightQuirks(BaseModel):
    """What is not known of real cameras."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")

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


class Answer(Protocol):
    """Takes what answers a command."""

    def __call__(self, data: bytes, *, more: bool = False) -> None:
        """Send bytes; with ``more`` the rest comes in another call."""
        ...


class Commands:
    """A camera's commands.

    Args:
        device: the camera.
        evaluations: answers to ``EV``: expression to the text that is sent; others fail.
        info: what ``GI`` tells, instead of the emulator's own.
        quirks: what is not known of real cameras.

    Raises:
        ConfigurationError: something given is wrong.
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
        for what, texts in (("info", self._info), ("evaluations", self._evaluations)):
            for name, text in texts.items():
                _check_sendable(f"{what}: {name}", text)
        self._table: Mapping[str, Callable[[str, Answer], None]] = {
            "GO": self._get_online,
            "SO": self._set_online,
            "SE": self._set_event,
            "SW": self._set_event_and_wait,
            "LF": self._load_file,
            "GF": self._get_file,
            "SJ": self._set_job,
            "GJ": self._get_job,
            "GV": self._get_value,
            "SI": self._set_integer,
            "SF": self._set_float,
            "SS": self._set_string,
            "GI": self._get_info,
            "EV": self._evaluate,
            "RI": self._read_image,
            "RB": self._read_image,
        }

    def execute(self, line: str, answer: Answer) -> None:
        """Do what a line says; the answer comes at once or when the device's time has come.

        Args:
            line: the command without its end.
            answer: takes what is sent.
        """
        mnemonic, argument = line[:2].upper(), line[2:]
        command = self._table.get(mnemonic)
        if command is None or (argument and not words.COMMANDS[mnemonic].arguments):
            answer(_coded(StatusCode.UNRECOGNIZED))
        else:
            command(argument, answer)

    # ------------------------------------------------------------------ mode and events

    def _get_online(self, _argument: str, answer: Answer) -> None:
        answer(_line(str(int(self._device.online))))

    def _set_online(self, argument: str, answer: Answer) -> None:
        known = argument in {"0", "1"}
        answer(
            _coded(
                self._device.request_online(argument == "1")
                if known
                else StatusCode.INVALID_ARGUMENT
            )
        )

    def _set_event(self, argument: str, answer: Answer) -> None:
        def told(code: StatusCode) -> None:
            sized = code == StatusCode.DONE and self.quirks.event_answer == "sized"
            answer(_sized("") if sized else _coded(code))

        self._event(argument, told, at_image=True)

    def _set_event_and_wait(self, argument: str, answer: Answer) -> None:
        self._event(argument, lambda code: answer(_coded(code)), at_image=False)

    def _event(self, argument: str, told: Callable[[StatusCode], None], *, at_image: bool) -> None:
        event = _integer(argument)
        if event is None or not 0 <= event <= words.TRIGGER_EVENT:
            told(StatusCode.INVALID_ARGUMENT)
        else:
            self._device.request_event(event, told, at_image=at_image)

    # ------------------------------------------------------------------ jobs

    def _load_file(self, argument: str, answer: Answer) -> None:
        self._load(argument or None, answer)

    def _set_job(self, argument: str, answer: Answer) -> None:
        number = _integer(argument)
        self._load(None if number is None or number < 0 else number, answer)

    def _load(self, job: str | int | None, answer: Answer) -> None:
        if job is None:
            answer(_coded(StatusCode.INVALID_ARGUMENT))
        else:
            self._device.request_job(job, lambda code: answer(_coded(code)))

    def _get_file(self, _argument: str, answer: Answer) -> None:
        job = self._device.job
        answer(_found(None if job is None else job.file))

    def _get_job(self, _argument: str, answer: Answer) -> None:
        job = self._device.job
        number = None if job is None else job.id
        answer(_found(None if number is None else str(number)))

    # ------------------------------------------------------------------ cells

    def _get_value(self, argument: str, answer: Answer) -> None:
        cell = words.parse_wire_cell(argument)
        key = self._named(argument) if cell is None else cell[0].wire
        if key is None or (cell is not None and cell[1]):
            answer(_coded(StatusCode.INVALID_ARGUMENT))
        else:
            answer(_found(self._device.cells.get(key)))

    def _set_integer(self, argument: str, answer: Answer) -> None:
        self._set_value(argument, answer, "int", _integer)

    def _set_float(self, argument: str, answer: Answer) -> None:
        self._set_value(argument, answer, "float", _number)

    def _set_string(self, argument: str, answer: Answer) -> None:
        self._set_value(argument, answer, "string", str)

    def _set_value(
        self,
        argument: str,
        answer: Answer,
        kind: str,
        read: Callable[[str], int | float | str | None],
    ) -> None:
        key, rest = self._target(argument)
        value = read(rest)
        if key is None or value is None:
            answer(_coded(StatusCode.INVALID_ARGUMENT))
        else:
            answer(_coded(self._device.request_value(key, kind, value)))

    def _target(self, argument: str) -> tuple[str | None, str]:
        """Return under what the cell to be set is kept, None if there is no such, and the rest."""
        cell = words.parse_wire_cell(argument)
        if cell is not None:
            return cell[0].wire, cell[1]
        name, _, rest = argument.partition(" ")
        return self._named(name), rest

    def _named(self, name: str) -> str | None:
        """Return under what a cell with a name is kept, None if there is no such.

        Cells are kept in upper case, so one without its three digits is not found.
        """
        key, job = name.lower(), self._device.job
        return key if job is not None and key in job.sources else None

    # ------------------------------------------------------------------ the rest

    def _get_info(self, _argument: str, answer: Answer) -> None:
        lines = (_line(f"{name}: {value}") for name, value in self._info.items())
        answer(_coded(StatusCode.DONE) + b"".join(lines))

    def _evaluate(self, argument: str, answer: Answer) -> None:
        text = self._evaluations.get(argument.strip())
        answer(_coded(StatusCode.FAILED) if text is None else _sized(text))

    def _read_image(self, _argument: str, answer: Answer) -> None:
        data = bitmap(self._device.image)
        digits, lines = words.hex_lines(data)
        size = digits if self.quirks.image_size == "digits" else len(data)
        answer(_found(str(size)), more=True)
        self._device.after(self.quirks.transfer_pause, lambda: answer(lines))


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


def _line(text: str) -> bytes:
    return text.encode(words.ENCODING) + words.LINE_END


def _coded(code: StatusCode) -> bytes:
    return _line(str(int(code)))


def _found(text: str | None) -> bytes:
    """Answer with what was asked for; None: not possible."""
    return _coded(StatusCode.FAILED) if text is None else _coded(StatusCode.DONE) + _line(text)


def _sized(text: str) -> bytes:
    return _found(str(len(text))) + _line(text)


def _check_sendable(where: str, text: str) -> None:
    try:
        text.encode(words.ENCODING)
    except UnicodeEncodeError as exc:
        raise ConfigurationError(f"{where}: only Latin-1 can be sent, got {text!r:.80}") from exc


def _integer(text: str) -> int | None:
    return int(text) if _INTEGER.fullmatch(text) else None


def _number(text: str) -> float | None:
    return float(text) if _NUMBER.fullmatch(text) else None
