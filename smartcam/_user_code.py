"""Handle the errors of code that a user passes in, so that our tasks go on.

An interpreter, a calibration, an observer, a predicate, a generator: where one is called
``except ENDS_PROGRAM: raise`` stands first, and then ``except BaseException``, which tells the
error where it belongs. ``Exception`` is too little: what ``pytest.fail`` raises is no
``Exception``, nor is ``CancelledError``, which would cancel the task that makes the call.
"""

from __future__ import annotations

from typing import Final

ENDS_PROGRAM: Final[tuple[type[BaseException], ...]] = (KeyboardInterrupt, SystemExit)
"""Exceptions that pass through every task and end the event loop."""


def text_of(error: BaseException) -> str:
    """Return the kind and the text of an error; it does not fail where the error's text does."""
    try:
        return f"{type(error).__name__}: {error}"
    except ENDS_PROGRAM:
        raise
    except BaseException as exc:  # noqa: BLE001 - the error is the user's own, too
        return f"{type(error).__name__} (its text cannot be had: {type(exc).__name__})"
