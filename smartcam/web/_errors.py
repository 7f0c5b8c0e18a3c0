"""Refuse a call with an answer in JSON that gives the reason."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pydantic import ValidationError

MAX_SHOWN_CHARACTERS = 200
"""Largest number of characters of a client's value that a refusal shows."""


@dataclass(eq=False)
class RefusedError(Exception):
    """A call cannot be carried out; the text says what was received, and what was expected."""

    status: int  # the HTTP status code
    received: str
    expected: str
    # of each wrong field: ``field``, ``received`` and ``expected``
    fields: tuple[dict[str, str], ...] = ()
    headers: Mapping[str, str] = field(default_factory=dict[str, str])  # headers of the answer

    def as_json(self, call: str) -> dict[str, Any]:
        """Return the answer's body; ``call``: method and path of the call."""
        answer = {
            "error": f"{call}: {self.received}; expected {self.expected}",
            "tried": call,
            "received": self.received,
            "expected": self.expected,
        }
        return {**answer, "fields": self.fields} if self.fields else answer


def short_repr(value: object) -> str:
    """Return a value's ``repr()``, cut after :data:`MAX_SHOWN_CHARACTERS` characters."""
    text = repr(value)
    return text if len(text) <= MAX_SHOWN_CHARACTERS else f"{text[:MAX_SHOWN_CHARACTERS]}..."


_EXPECTED = {"missing": "a value", "extra_forbidden": "no such field"}


def _expected(kind: str, text: str) -> str:
    return _EXPECTED.get(kind) or text.removeprefix("Input should be ").removeprefix(
        "Value error, "
    )


def wrong_fields_error(error: ValidationError) -> RefusedError:
    """Return the refusal of a body or a query with wrong fields (422)."""
    fields = tuple(
        {
            "field": ".".join(str(part) for part in item["loc"]),
            "received": "nothing" if item["type"] == "missing" else short_repr(item["input"]),
            "expected": _expected(item["type"], item["msg"]),
        }
        for item in error.errors(include_url=False)
    )
    received = "; ".join(f"{field['field'] or 'the body'}: {field['received']}" for field in fields)
    expected = "; ".join(field["expected"] for field in fields)
    return RefusedError(422, received, expected, fields)
