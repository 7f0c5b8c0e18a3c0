"""List all checks and questions, in the order in which a camera is tested.

Items that change least come first; items that may leave a camera confused (bytes that are no frame,
a restart) come last. Each module lists its own in this order.
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
    member for module in _MODULES for member in vars(module).values() if isinstance(member, Item)
]


def _is_late(item: Item) -> tuple[bool, bool]:
    return item is message_checks.only_documented_messages_came, Allow.REBOOT in item.needs


ITEMS: tuple[Item, ...] = tuple(sorted(_DECLARED, key=_is_late))
"""All checks and questions, in the order in which they are judged."""

CHECKS: tuple[Check, ...] = tuple(item for item in ITEMS if isinstance(item, Check))
"""The checks among the items."""

QUESTIONS: tuple[Question, ...] = tuple(item for item in ITEMS if isinstance(item, Question))
"""The questions among the items."""
