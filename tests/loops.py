"""The event loops that tests run in, and others that one run may have in their place.

``SMARTCAM_TEST_LOOP`` is ``eager`` (every task begins where it is made, Python 3.12 and later),
``debug`` (asyncio's debug mode), ``eager debug``, or ``uvloop``, whose time cannot be moved: then
the tests that need a time of their own are left out.
"""

from __future__ import annotations

import asyncio
import importlib
import os
from collections.abc import Callable

from tests.timed_loop import TimedLoop

LOOP = os.environ.get("SMARTCAM_TEST_LOOP", "")
"""The loop that all tests are to have; empty for the usual ones."""

if LOOP not in {"", "eager", "debug", "eager debug", "uvloop"}:
    raise ValueError(f"SMARTCAM_TEST_LOOP is eager, debug, both or uvloop, not {LOOP!r}")


def timed() -> asyncio.AbstractEventLoop:
    """Return a loop on a time of its own; uvloop's, where that is asked for, has the real one."""
    return real() if LOOP == "uvloop" else _changed(TimedLoop())


def real() -> asyncio.AbstractEventLoop:
    """Return a loop on the real time."""
    if LOOP == "uvloop":
        loop: asyncio.AbstractEventLoop = importlib.import_module("uvloop").new_event_loop()
        return loop
    return _changed(asyncio.SelectorEventLoop())


def _changed(loop: asyncio.AbstractEventLoop) -> asyncio.AbstractEventLoop:
    if "eager" in LOOP:
        loop.set_task_factory(getattr(asyncio, "eager_task_factory"))  # noqa: B009 - of 3.12
    if "debug" in LOOP:
        loop.set_debug(True)
    return loop


Loop = Callable[[], asyncio.AbstractEventLoop]
