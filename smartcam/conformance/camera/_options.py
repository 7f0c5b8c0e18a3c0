"""The options of a camera's examination: the camera, the allowed actions, the times to wait."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from smartcam._arguments import (
    MAX_APPLICATION_ID,
    check_bytes,
    check_integer,
    check_kind,
    check_number,
    check_text,
)
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable

MAX_SECONDS = 3600.0
"""Largest number of seconds of one wait."""

MAX_INPUT_DATA_BYTES = 1 << 16
"""Largest number of bytes of input data: about 64 kB, the limit of result containers (HAL 15,
published); no document gives one for input data."""


class Allow(enum.Flag):
    """The actions that are allowed on a camera.

    ``RUN``, ``TRIGGER`` and ``SWITCH`` are allowed unless options forbid them, since their changes
    are undone. The others leave a change.
    """

    NOTHING = 0
    RUN = enum.auto()
    """Start and stop; undone afterwards."""
    TRIGGER = enum.auto()
    """Inspect; devices at the camera's outputs react."""
    SWITCH = enum.auto()
    """Load an application; the application that was active before is loaded again."""
    CLOCK = enum.auto()
    """Set the clock; restored to the second."""
    NUMBER = enum.auto()
    """Set the number of the next run, which cannot be read, and so not be restored."""
    INPUT = enum.auto()
    """Send input data; the camera's queue may keep data until an application is loaded."""
    ERRORS = enum.auto()
    """Reset error bits that stay set; they cannot be restored."""
    REBOOT = enum.auto()
    """Restart; the clock is lost and the numbering begins at 0."""

    @classmethod
    def read(cls, text: str) -> Allow:
        """Read names with commas: they are added to the defaults, which ``nothing`` removes.

        Raises:
            ConfigurationError: a name is unknown.
        """
        names = [name.strip().lower() for name in text.split(",") if name.strip()]
        allowed = cls.RUN | cls.TRIGGER | cls.SWITCH
        if "nothing" in names:
            allowed = cls.NOTHING
        for name in names:
            if name == "all":
                allowed |= ~cls.NOTHING
            elif name.upper() not in cls.__members__:
                known = ", ".join([*(member.lower() for member in cls.__members__), "all"])
                raise ConfigurationError(f"--camera-allow: {name!r} is unknown; known are {known}")
            else:
                allowed |= cls[name.upper()]
        return allowed

    @property
    def names(self) -> list[str]:
        """The actions' names, in lower case."""
        return [flag.name.lower() for flag in type(self) if flag in self and flag.name]


@dataclass(frozen=True, slots=True, kw_only=True)
class ConformanceOptions:
    """The options of a judgement. Times are seconds.

    Attributes:
        url: the camera's address; if it does not name the dialect, the dialect is found out.
        application: id of the application to trigger, None for the active one.
        other_application: id of another application that may be loaded, None for none.
        allow: actions that are allowed at the camera.
        timeout: longest time for an answer, a status or a result.
        silence: time without a message after which the camera counts as silent.
        switch_timeout: longest time for loading an application.
        reboot_timeout: longest time for a restart.
        sequence_offset: offset of the sequence number, an int32, in the application's results,
            counted from the end of the application's id; None if the results have no number.
        input_data: input data that the application accepts, None for none.

    Raises:
        ConfigurationError: a value is not valid, or both applications are the same.
    """

    url: str
    application: int | None = None
    other_application: int | None = None
    allow: Allow = Allow.RUN | Allow.TRIGGER | Allow.SWITCH
    timeout: float = 5.0
    silence: float = 0.5
    switch_timeout: float = 30.0
    reboot_timeout: float = 180.0
    sequence_offset: int | None = None
    input_data: bytes | None = None

    def __post_init__(self) -> None:
        check_text(self.url, "url", least=1)
        check_kind(self.allow, Allow, "allow", "flags of Allow")
        for name in ("timeout", "silence", "switch_timeout", "reboot_timeout"):
            seconds = check_number(
                getattr(self, name), name, 0, MAX_SECONDS, exclusive=True, unit="seconds"
            )
            object.__setattr__(self, name, seconds)
        for name, minimum, maximum in (
            ("application", 1, MAX_APPLICATION_ID),
            ("other_application", 1, MAX_APPLICATION_ID),
            ("sequence_offset", 0, 0xFFFF),
        ):
            if getattr(self, name) is not None:
                number = check_integer(getattr(self, name), name, minimum, maximum)
                object.__setattr__(self, name, number)
        if self.other_application is not None and self.other_application == self.application:
            raise ConfigurationError(f"both applications are {self.application}: name another one")
        if self.input_data is not None:
            object.__setattr__(self, "input_data", check_bytes(self.input_data, "input_data"))
        if self.input_data is not None and len(self.input_data) > MAX_INPUT_DATA_BYTES:
            raise ConfigurationError(
                f"input_data has {len(self.input_data)} bytes: {MAX_INPUT_DATA_BYTES} at most"
            )


def _parse_hex(text: str) -> bytes:
    try:
        return bytes.fromhex(text)
    except ValueError as exc:
        raise ConfigurationError(f"--camera-input: {text!r} is not hex: {exc}") from exc


OPTION_PARSERS: dict[str, tuple[str, Callable[[str], Any]]] = {
    "--camera-application": ("application", int),
    "--camera-other-application": ("other_application", int),
    "--camera-allow": ("allow", Allow.read),
    "--camera-timeout": ("timeout", float),
    "--camera-silence": ("silence", float),
    "--camera-switch-timeout": ("switch_timeout", float),
    "--camera-reboot-timeout": ("reboot_timeout", float),
    "--camera-sequence-offset": ("sequence_offset", int),
    "--camera-input": ("input_data", _parse_hex),
}
"""Field of :class:`ConformanceOptions` for each command-line option, and the option's parser."""
