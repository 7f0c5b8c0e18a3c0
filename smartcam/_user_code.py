"""Handle the errors of code that a user passes in, so that smartcam's tasks go on.

Each call of an interpreter, a calibration, an observer, a predicate or a generator is followed by
``except ENDS_PROGRAM: raise``, and then by ``except BaseException``, which reports the error.
``except Exception`` would miss the error of ``pytest.fail``, and CancelledError, which would cancel
the calling task.
"""

from __future__ import annotations

from typing import Final

ENDS_PROGRAM: Final[tuple[type[BaseException], ...]] = (KeyboardInterrupt, SystemExit)
"""Exceptions that pass through every task and end the event loop."""


def text_of(error: BaseException) -> str:
    """Return the class and the text of an error, even if the error's ``__str__`` fails."""
    try:
        return f"{type(error).__name__}: {error}"
    except ENDS_PROGRAM:
        raise
    except BaseException as exc:  # noqa: BLE001 - the error is the user's own, too
        return f"{type(error).__name__} (its text cannot be had: {type(exc).__name__})"
