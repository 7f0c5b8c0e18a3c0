"""Notify objects in a fork of this process, where only one thread runs.

A fork has a copy of all memory, but only the thread that called ``fork``. A lock that another
thread held at that moment stays locked in the fork forever, and what other threads had begun is
never finished. So no module has a lock of its own, and objects with locks that are shared in a
process register themselves here.
"""

from __future__ import annotations

import functools
import os
import sys
import weakref
from typing import TYPE_CHECKING, Any, Protocol


class KnowsForks(Protocol):
    """An object that is notified of forks."""

    def on_fork(self) -> None:
        """Reset the state that belongs to other threads; must not wait. Called in the fork."""


_objects_to_notify: weakref.WeakSet[Any] = weakref.WeakSet()


def notify_of_forks(notified: KnowsForks) -> None:
    """Notify an object of each fork, in the fork, as long as the object lives."""
    _objects_to_notify.add(notified)


def _notify_all() -> None:
    for notified in tuple(_objects_to_notify):
        notified.on_fork()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_notify_all)


if TYPE_CHECKING:
    from functools import cached_property as cached_property  # other modules import it from here
elif sys.version_info >= (3, 12):
    from functools import cached_property
else:

    class cached_property(functools.cached_property):  # noqa: N801 - as functools has it
        """A value that is computed once for each object, as Python 3.12 does it.

        Python 3.11 holds a lock of the class meanwhile, which may be locked in a fork.
        """

        def __get__(self, instance: Any, owner: Any = None) -> Any:
            """Return the value; if two threads compute it at once, the later value stays."""
            if instance is None:
                return self
            values = instance.__dict__
            if self.attrname not in values:
                values[self.attrname] = self.func(instance)
            return values[self.attrname]
