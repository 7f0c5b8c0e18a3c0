"""Check the values that users and other people's programs pass in.

Each function returns the plain value, and only that value is used: an ``int`` or ``str`` of a
subclass may compare, hash and print as it likes. A value that cannot work is a
:exc:`~smartcam.ConfigurationError` that names the argument, the expected value, and the given
value. The checks search, send and wait for nothing.

``owner`` names the owner of the argument, such as a camera; "" if the argument's name suffices.
"""

from __future__ import annotations

import contextlib
import math
import numbers
import os
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, TypeVar, cast

from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable

T = TypeVar("T")
FunctionT = TypeVar("FunctionT", bound="Callable[..., Any]")

MAX_SECONDS = 1e9
"""Seconds that a time may have at most, about 31 years: more would overflow a loop's timer."""

MAX_TEXT_LENGTH = 10_000
"""Largest number of characters that a text may have, if no smaller bound is given."""

MAX_DATA_BYTES = 1 << 30
"""Largest number of bytes of a byte string; also the largest payload that a client may
accept."""

MAX_NAME_CHARACTERS = 200
"""Largest number of characters of a camera's name from a user."""

MAX_OPTION_SECONDS = 86_400.0
"""Largest value in seconds of an option of a connection that is a time limit."""

MAX_CONNECT_ATTEMPTS = 100
"""Largest number of connections that may be tried to make a session."""

MIN_PAYLOAD_LIMIT_BYTES = 16
"""Least value of ``max_length``, the largest payload that a client accepts."""

MAX_SHOWN_LENGTH = 80
"""Largest number of characters of a wrong value that an error's text shows."""

MAX_APPLICATION_ID = 0xFFFFFFFF
"""Largest application id that any dialect has a field for, 32 bits."""


def excerpt(value: object) -> str:
    """Return a value as an error's text shows it, whatever its ``repr`` does."""
    try:
        return f"{value!r:.{MAX_SHOWN_LENGTH}}"
    except ValueError:
        return f"{type(value).__name__} that is too long to be shown"
    except Exception:  # noqa: BLE001 - whatever a class of somebody's raises there
        return f"{type(value).__name__} that cannot be shown"


def duration_text(seconds: float, *, coarse: bool = False) -> str:
    """Return a time as an error's text shows it: ``2.5 s``, ``4.2 ms``.

    Seconds have at most two digits after the point, or with ``coarse`` always one. A time that is
    too short for these digits is shown in milliseconds.
    """
    if 0 < seconds < (0.05 if coarse else 0.01):
        return f"{seconds * 1000:.3g} ms"
    return f"{seconds:.1f} s" if coarse else f"{round(seconds, 2):g} s"


def wrong_argument(name: str, expected: str, value: object, owner: str = "") -> ConfigurationError:
    """Return the error for an argument that cannot work."""
    return ConfigurationError(
        f"{owner}{': ' if owner else ''}{name}: expected {expected}, got {excerpt(value)}"
    )


def check_integer(
    value: object, name: str, minimum: int, maximum: int | None = None, owner: str = ""
) -> int:
    """Return an integer from ``minimum`` to ``maximum``; None: without an upper limit.

    Integers of numpy and others with ``__index__`` are accepted, ``bool`` is not.
    """
    number = value if type(value) is int else _as_integer(value)
    if number is None or number < minimum or (maximum is not None and number > maximum):
        up_to = "or more" if maximum is None else f"to {maximum}"
        raise wrong_argument(name, f"an integer, {minimum} {up_to}", value, owner)
    return number


def _as_integer(value: Any) -> int | None:
    if isinstance(value, bool):
        return None
    try:
        return int.__index__(type(value).__index__(value))
    except Exception:  # noqa: BLE001 - whatever a class of somebody's raises there
        return None


def as_plain_value(value: object) -> object:
    """Return a number, truth value or text of any class as its plain value; others unchanged.

    Pydantic's strict types get the plain value, since they refuse numpy's numbers.
    """
    kind = type(value)
    if kind in {int, float, str, bool} or isinstance(value, bool):
        return value
    if isinstance(value, str):
        return str.__str__(value)
    if _is_numpy_bool(value):
        return bool(value)
    integer = _as_integer(value)
    if integer is not None:
        return integer
    number = _as_float(value)
    return value if number is None else number


def check_number(
    value: object,
    name: str,
    minimum: float,
    maximum: float,
    owner: str = "",
    *,
    exclusive: bool = False,
    unit: str = "a number",
) -> float:
    """Return a finite number in bounds; with ``exclusive`` not ``minimum`` itself.

    Numbers of numpy and fractions are accepted; ``bool``, texts and arrays are not.
    """
    number = value if type(value) is float else _as_float(value)
    if number is None or not minimum <= number <= maximum or (exclusive and number == minimum):
        raise wrong_argument(
            name, f"{unit}, {'above ' if exclusive else ''}{minimum:g} to {maximum:g}", value, owner
        )
    return number


def _as_float(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        return None
    try:
        return float.__float__(type(value).__float__(cast("Any", value)))
    except Exception:  # noqa: BLE001 - 10**400, and whatever a class of somebody's raises there
        return None


def check_seconds(value: object, name: str, owner: str = "", *, exclusive: bool = False) -> float:
    """Return a time in seconds, 0 or more; with ``exclusive``, more than 0."""
    if type(value) is float and 0.0 < value <= MAX_SECONDS:
        return value
    return check_number(value, name, 0.0, MAX_SECONDS, owner, exclusive=exclusive, unit="seconds")


def check_seconds_or_none(
    value: object, name: str, owner: str = "", *, exclusive: bool = False
) -> float | None:
    """Return a time in seconds as :func:`check_seconds` does, or None."""
    return None if value is None else check_seconds(value, name, owner, exclusive=exclusive)


def check_clock_seconds(value: object, name: str, owner: str = "") -> float:
    """Return a time of any clock: any finite number of seconds."""
    if type(value) is float and math.isfinite(value):
        return value
    number = _as_float(value)
    if number is None or not math.isfinite(number):
        raise wrong_argument(name, "a finite number of seconds", value, owner)
    return number


def check_age(value: object, name: str, owner: str = "") -> float:
    """Return an age in seconds, 0 or more; ``inf`` is allowed."""
    number = _as_float(value)
    if number is None or not number >= 0:
        raise wrong_argument(name, "0 or more seconds, or inf", value, owner)
    return number


def check_flag(value: object, name: str, owner: str = "") -> bool:
    """Return True or False; numpy's truth values are accepted, too."""
    if isinstance(value, bool):
        return value
    if _is_numpy_bool(value):
        return bool(value)
    raise wrong_argument(name, "True or False", value, owner)


def _is_numpy_bool(value: object) -> bool:
    kind = type(value)
    return kind.__module__ == "numpy" and kind.__name__ in {"bool", "bool_"}


def check_text(
    value: object, name: str, owner: str = "", *, least: int = 0, most: int = MAX_TEXT_LENGTH
) -> str:
    """Return a text of ``least`` to ``most`` characters that UTF-8 can encode."""
    if isinstance(value, str):
        text = str.__str__(value)
        if least <= len(text) <= most and (text.isascii() or not _has_surrogates(text)):
            return text
    raise wrong_argument(name, f"a text of {least} to {most} characters", value, owner)


def _has_surrogates(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:
        return True
    return False


def check_choice(value: object, name: str, known: Collection[str], owner: str = "") -> str:
    """Return a text that is one of the known words."""
    if isinstance(value, str) and str.__str__(value) in known:
        return str.__str__(value)
    raise wrong_argument(name, " or ".join(map(repr, known)), value, owner)


def check_bytes(value: object, name: str, owner: str = "") -> bytes:
    """Return a byte string: bytes, or an object with a buffer, such as a ``bytearray``."""
    if type(value) is bytes:
        return value
    with contextlib.suppress(Exception):  # the object has no buffer, or fails to give it
        view = memoryview(cast("Any", value))
        if view.ndim and view.nbytes <= MAX_DATA_BYTES:  # a number of numpy has a buffer, too
            return view.tobytes()
    raise wrong_argument(name, f"bytes, {MAX_DATA_BYTES} at most", value, owner)


def check_callable(value: FunctionT, name: str, owner: str = "") -> FunctionT:
    """Return a value that can be called."""
    if not callable(value):
        raise wrong_argument(name, "a function", value, owner)
    return value


def check_kind(value: T, kind: type[Any], name: str, expected: str, owner: str = "") -> T:
    """Return an object of a class; ``expected`` describes the class in words."""
    if not isinstance(value, kind):
        raise wrong_argument(name, expected, value, owner)
    return value


def check_iterable(value: Iterable[T], name: str, expected: str, owner: str = "") -> tuple[T, ...]:
    """Return the items of an iterable; a text is refused."""
    with contextlib.suppress(Exception):  # a class of the user may raise anything
        if not isinstance(value, (str, bytes)):
            return tuple(value)
    raise wrong_argument(name, expected, value, owner)


def check_aware_datetime(value: datetime | None, name: str, owner: str = "") -> datetime | None:
    """Return a date and time with a time zone, or None."""
    if value is not None and (not isinstance(value, datetime) or value.tzinfo is None):
        raise wrong_argument(name, "a datetime with a time zone, or None", value, owner)
    return value


def check_datetime(value: datetime, name: str, owner: str = "") -> datetime:
    """Return a date with a time."""
    return check_kind(value, datetime, name, "a datetime", owner)


def check_application(value: object, name: str = "application", owner: str = "") -> int:
    """Return an application's id; 0 is allowed here, since the camera itself refuses it."""
    return check_integer(value, name, 0, MAX_APPLICATION_ID, owner)


def check_application_or_name(
    value: object, argument: str = "application", owner: str = ""
) -> int | str:
    """Return an application's id, or the name of its file."""
    if not isinstance(value, str):
        return check_application(value, argument, owner)
    name = check_text(value, argument, owner, least=1, most=200)
    if not name.isprintable():
        raise wrong_argument(argument, "a file's name that can be printed", value, owner)
    return name


def check_message_id(value: object, name: str = "message_id", owner: str = "") -> int | str:
    """Return a message's id: a number of 32 bits, or a command's text."""
    if isinstance(value, str):
        return check_text(value, name, owner, least=1, most=200)
    return check_integer(value, name, 0, 0xFFFFFFFF, owner)


def check_path(value: object, name: str, owner: str = "") -> Path:
    """Return the path of a file or folder: a text, or an object such as a ``Path``."""
    text: object = value
    if isinstance(value, os.PathLike):
        with contextlib.suppress(Exception):  # a class of the user may raise anything
            text = os.fspath(cast("os.PathLike[str]", value))
    if isinstance(text, str):
        path = str.__str__(text)
        if 0 < len(path) <= MAX_TEXT_LENGTH and "\0" not in path and _is_name_of_file(path):
            return Path(path)
    raise wrong_argument(name, "the path of a file or folder", value, owner)


def _is_name_of_file(path: str) -> bool:
    try:
        os.fsencode(path)  # a name that is no UTF-8 has surrogates
    except UnicodeEncodeError:
        return False
    return True


def fspath_of(value: object) -> object:
    """Return the text of a path; any other value unchanged."""
    return str(value) if isinstance(value, PurePath) else value


def check_seed(value: object, owner: str = "") -> int:
    """Return the seed of random choices: any integer of 64 bits."""
    return check_integer(value, "seed", -(1 << 63), (1 << 64) - 1, owner)


def check_port(value: object, owner: str = "") -> int:
    """Return the number of a port to listen on; 0 means any free port."""
    return check_integer(value, "port", 0, 0xFFFF, owner)


def check_texts(value: object, name: str, owner: str = "") -> dict[str, str]:
    """Return a mapping from texts to texts."""
    if not isinstance(value, Mapping):
        raise wrong_argument(name, "a mapping from texts to texts", value, owner)
    pairs = cast("Mapping[object, object]", value).items()
    return {check_text(key, name, owner): check_text(text, name, owner) for key, text in pairs}
