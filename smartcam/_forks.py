"""Forget, in a fork of this process, the locks that other threads held, and the threads.

A fork has one thread, the one that called it, and a copy of all else. A lock that another thread
held at that moment stays locked in the copy forever, and the work of other threads is never
finished. So no module here has a lock of its own, and objects with locks are notified.
"""

from __future__ import annotations

import functools
import os
import sys
import weakref
from typing import TYPE_CHECKING, Any, Protocol


class KnowsForks(Protocol):
    """An object that is notified of forks."""

    def forked(self) -> None:
        """Start anew in a fork: no other thread runs there; do not wait."""


_objects_to_notify: weakref.WeakSet[Any] = weakref.WeakSet()


def notify_of_forks(notified: KnowsForks) -> None:
    """Notify an object of each fork, in the fork, as long as the object lives."""
    _objects_to_notify.add(notified)


def _notify_all() -> None:
    for notified in tuple(_objects_to_notify):
        notified.forked()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_notify_all)


if TYPE_CHECKING:
    from functools import cached_property as cached_property  # other modules import it from here
elif sys.version_info >= (3, 12):
    from functools import cached_property
else:

    class cached_property(functools.cached_property):  # noqa: N801 - as functools has it
        """A value that is made once for each object, as Python 3.12 has it.

        Python 3.11 holds a lock of the class meanwhile, which a fork may inherit as locked.
        """

        def __get__(self, instance: Any, owner: Any = None) -> Any:
            """Return the value; two threads may each make it, and the later one stays."""
            if instance is None:
                return self
            values = instance.__dict__
            if self.attrname not in values:
                values[self.attrname] = self.func(instance)
            return values[self.attrname]
