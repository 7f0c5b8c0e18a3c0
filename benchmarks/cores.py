"""Which cores a side and its peer have: it decides more of a short exchange than what is measured.

Where the peer sleeps on another core, whoever sends has to wake that core; on a virtual machine
this is 30 to 40 us of the sender's CPU time, for any sender, and nothing where that core is busy
with something else. Left to itself the system does now the one, now the other. So where both wait
for each other in turns they have one core, or expressly two. Other systems than Linux place them as
they like.
"""

from __future__ import annotations

import contextlib
import os
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["for_peers", "free", "placed"]

_all: set[int] = os.sched_getaffinity(0) if sys.platform == "linux" else set()
_peers: set[int] = set()


@contextlib.contextmanager
def placed(*, apart: bool) -> Iterator[None]:
    """Have this process on one core, and the peers that are begun meanwhile there or on another."""
    global _peers
    if not _all:
        yield
        return
    _peers = {max(_all)} if apart else {min(_all)}
    with _on({min(_all)}):
        try:
            yield
        finally:
            _peers = set()


@contextlib.contextmanager
def for_peers() -> Iterator[None]:
    """Begin processes where peers are to be."""
    with _on(_peers):
        yield


@contextlib.contextmanager
def free() -> Iterator[None]:
    """Begin processes and threads wherever there is room."""
    with _on(_all):
        yield


@contextlib.contextmanager
def _on(cores: set[int]) -> Iterator[None]:
    """Have this thread, and what it begins, on some cores; without any, where it is."""
    if sys.platform != "linux" or not cores:
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
