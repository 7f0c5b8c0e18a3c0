"""List all checks and questions (items), in the order in which a camera is tested.

Items that change the camera least come first. Items that send invalid bytes or restart the camera
may leave it in a wrong state, so they come late. Each module defines its items in this order.
"""

from __future__ import annotations

from smartcam.conformance.camera import (
    _message_checks as message_checks,
)
from smartcam.conformance.camera import (
    _questions as questions,
)
from smartcam.conformance.camera import (
    _running_checks as running_checks,
)
from smartcam.conformance.camera import (
    _session_checks as session_checks,
)
from smartcam.conformance.camera import (
    _setting_checks as setting_checks,
)
from smartcam.conformance.camera._options import Allow
from smartcam.conformance.camera._results import Check, Item, Question

_MODULES = (session_checks, running_checks, setting_checks, message_checks, questions)
_DECLARED = [
    value for module in _MODULES for value in vars(module).values() if isinstance(value, Item)
]


def _sort_key(item: Item) -> tuple[bool, bool]:
    """Return a key that sorts items with a restart, then the check of all messages, to the end."""
    return item is message_checks.only_documented_messages_came, Allow.REBOOT in item.needs


ITEMS: tuple[Item, ...] = tuple(sorted(_DECLARED, key=_sort_key))
"""All checks and questions, in the order in which they are judged."""

CHECKS: tuple[Check, ...] = tuple(item for item in ITEMS if isinstance(item, Check))
"""The checks among the items."""

QUESTIONS: tuple[Question, ...] = tuple(item for item in ITEMS if isinstance(item, Question))
"""The questions among the items."""
