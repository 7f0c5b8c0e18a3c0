"""Send errors over the bus: their class, text and attributes, and their causes."""

from __future__ import annotations

import builtins
import contextlib
from typing import Any, cast

import smartcam.exceptions
from smartcam.exceptions import (
    RemoteProtocolError,
    ResponseTimeoutError,
    SmartCamError,
    TriggerTimeoutError,
)
from smartcam.models import jsonable

MAX_CHAIN = 8
"""Largest number of chained causes of one error that cross the bus."""


def to_fields(error: BaseException, depth: int = MAX_CHAIN) -> dict[str, Any]:
    """Return an error as fields for JSON; its ``kind`` is its class, or the nearest known base."""
    names = (base.__name__ for base in type(error).__mro__)
    kind = next((name for name in names if name in _ERROR_CLASSES), None)
    if kind is None:
        fields: dict[str, Any] = {
            "kind": SmartCamError.__name__,
            "text": f"{type(error).__name__}: {error}",
        }
    else:
        # the text of a KeyError is its argument in quotes
        text = error.args[0] if isinstance(error, KeyError) and error.args else error
        fields = {"kind": kind, "text": str(text)}
    values = vars(error) if isinstance(error, SmartCamError) else {}
    attributes = {name: _as_json(value) for name, value in values.items() if name[0] != "_"}
    if attributes:
        fields["attributes"] = attributes
    if error.__cause__ is not None and depth:
        fields["cause"] = to_fields(error.__cause__, depth - 1)
    return fields


def from_fields(fields: Any) -> SmartCamError:
    """Return the error that ``fields`` describe."""
    error = _from_fields(fields)
    if isinstance(error, SmartCamError):
        return error
    return SmartCamError(f"{type(error).__name__}: {error}")


def _from_fields(fields: Any) -> BaseException:
    if not isinstance(fields, dict):
        return RemoteProtocolError(f"the agent's error is not valid: {fields!r:.80}")
    known = cast("dict[str, Any]", fields)
    error = _ERROR_CLASSES.get(str(known.get("kind")), SmartCamError)(str(known.get("text", "")))
    attributes: Any = known.get("attributes")
    if isinstance(attributes, dict):
        for name, value in cast("dict[str, Any]", attributes).items():
            if name in vars(error):  # the class's own attributes, with their defaults
                setattr(error, name, _from_json(value))
    if "cause" in known:
        error.__cause__ = _from_fields(known["cause"])
    return error


def _as_json(value: object) -> Any:
    """Return an attribute's value for JSON: a tuple, or bytes, as an object that names the type."""
    if isinstance(value, (tuple, bytes)):
        return {type(value).__name__: jsonable(value)}
    return jsonable(value)


def _from_json(value: Any) -> Any:
    if isinstance(value, dict):
        pair = cast("dict[str, Any]", value)
        if pair.keys() == {"tuple"} and isinstance(pair["tuple"], list):
            return tuple(pair["tuple"])
        if pair.keys() == {"bytes"} and isinstance(pair["bytes"], str):
            with contextlib.suppress(ValueError):
                return bytes.fromhex(pair["bytes"])
    return cast("object", value)


_ERROR_CLASSES: dict[str, type[BaseException]] = {
    **{
        name: kind
        for name, kind in vars(builtins).items()
        if isinstance(kind, type) and issubclass(kind, (OSError, LookupError, ValueError))
        if not issubclass(kind, UnicodeError)  # needs more arguments than a text
    },
    **{
        name: getattr(smartcam.exceptions, name)
        for name in smartcam.exceptions.__all__
        if issubclass(getattr(smartcam.exceptions, name), SmartCamError)
    },
}
"""Classes of errors that cross the bus: smartcam's, and Python's for causes."""


def late_call_error(action: str, text: str) -> SmartCamError:
    """Return the error of a call whose deadline has passed before it was carried out."""
    error_class = TriggerTimeoutError if "trigger" in action.lower() else ResponseTimeoutError
    return error_class(text)
