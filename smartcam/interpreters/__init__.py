"""Turn the bytes of result containers into values; no clock and no socket is used.

``localizations``, ``strings50``, ``record``, ``table`` and ``raw`` come with smartcam, others as
entry points of the group ``smartcam.interpreters``.
"""

from __future__ import annotations

from smartcam.interpreters._base import Context, Interpreter, PlainInterpreter, Reader, resolve, run

__all__ = [
    "Context",
    "Interpreter",
    "PlainInterpreter",
    "Reader",
    "resolve",
    "run",
]
