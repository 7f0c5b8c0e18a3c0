"""Find the argument of a wrong kind after a function has failed, and raise an error that names it.

Only kinds are checked. For numbers, shapes or words that cannot work, the function raises an error
of its own.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import math
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar, cast

from smartcam._arguments import as_plain_value, check_iterable, wrong_argument
from smartcam.exceptions import SmartCamError

if TYPE_CHECKING:
    from collections.abc import Callable

    Check = Callable[[Any, str, str], Any]

P = ParamSpec("P")
R = TypeVar("R")


def check_arguments(**checks: Check) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Return a decorator for a function whose errors name the argument that is of a wrong kind.

    The function is called first, and an error of the library is raised unchanged. After any other
    error each check gets the argument of its name. The first check that finds a wrong kind raises
    a ConfigurationError, whose text begins with the function's name, or for an ``__init__`` with
    the name of its class. If all are of the right kind, the function is called once more, with the
    plain values that the checks return, since a subclass of ``str`` or ``float`` may have caused
    the error. So the function has to allow a second call.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(function)
        owner = function.__qualname__.removesuffix(".__init__")

        @functools.wraps(function)
        def call(*args: P.args, **options: P.kwargs) -> R:
            try:
                return function(*args, **options)
            except SmartCamError:
                raise
            except Exception:  # noqa: BLE001 - the checks or the second call raise the error
                bound = signature.bind(*args, **options)
                for name, check in checks.items():
                    if name in bound.arguments:
                        bound.arguments[name] = check(bound.arguments[name], name, owner)
            return function(*bound.args, **bound.kwargs)

        return call

    return decorate


def a_number(value: Any, name: str, owner: str) -> Any:
    """Return a plain number that a float can hold; ``bool`` is not a number here."""
    number = as_plain_value(value)
    if isinstance(number, (int, float)) and not isinstance(number, bool):
        try:
            float(number)
        except OverflowError:
            pass
        else:
            return number
    raise wrong_argument(name, "a number", value, owner)


def a_finite_number(value: Any, name: str, owner: str) -> Any:
    """Return a plain number that is neither infinite nor NaN."""
    number = a_number(value, name, owner)
    if not math.isfinite(number):
        raise wrong_argument(name, "a finite number", value, owner)
    return number


def an_integer(value: Any, name: str, owner: str) -> Any:
    """Return a plain integer of at most 64 bits; ``bool`` is not an integer here."""
    number = as_plain_value(value)
    if type(number) is int and -(1 << 63) <= number < 1 << 63:
        return number
    raise wrong_argument(name, "a whole number", value, owner)


def a_list(value: Any, name: str, owner: str) -> Any:
    """Return the items of a sequence; a text is refused."""
    return check_iterable(value, name, "a list", owner)


def numbers(value: Any, name: str, owner: str) -> Any:
    """Return an array of numbers, of any shape."""
    import numpy as np

    with contextlib.suppress(Exception):  # a class of the user may raise anything
        array = np.asarray(value)
        if array.dtype.kind in "fiubO":  # objects: fractions, and integers too large for numpy's
            return array.astype(np.float64)
    raise wrong_argument(name, "an array of numbers", value, owner)


def as_array(value: Any, name: str) -> Any:
    """Return a value as an array of any kind.

    Raises:
        ConfigurationError: the value is no array.
    """
    import numpy as np

    try:
        return np.asarray(value)
    except Exception as exc:  # a class of the user may raise anything
        raise wrong_argument(name, "an array", value) from exc


def of_class(name: str) -> Check:
    """Return a check for an object of a class of this name, which need not be imported."""

    def check(value: Any, argument: str, owner: str) -> Any:
        if any(class_.__name__ == name for class_ in cast("Any", type(value)).__mro__):
            return value
        raise wrong_argument(argument, f"a {name}", value, owner)

    return check


def a_target(value: Any, name: str, owner: str) -> Any:
    """Return a target that is printed and found in images."""
    if hasattr(type(value), "kind") and hasattr(type(value), "points"):
        return value
    raise wrong_argument(name, "a target, such as a Checkerboard", value, owner)


def each(check: Check, count: int | None = None) -> Check:
    """Return a check for a list whose items pass ``check``, with ``count`` items if given."""

    def check_each(value: Any, name: str, owner: str) -> Any:
        items = a_list(value, name, owner)
        if count is not None and len(items) != count:
            raise wrong_argument(name, f"{count} of them", value, owner)
        return tuple(check(item, name, owner) for item in items)

    return check_each


def or_none(check: Check) -> Check:
    """Return a check that accepts None, too."""

    def check_unless_none(value: Any, name: str, owner: str) -> Any:
        return None if value is None else check(value, name, owner)

    return check_unless_none
