"""All checks and questions, in the order in which a camera is put through them.

What leaves least behind comes first; what may leave a camera confused (bytes that are no frame, a
restart) last.
"""

from __future__ import annotations

from smartcam.conformance.camera import (
    message_checks,
    questions,
    running_checks,
    session_checks,
    setting_checks,
)
from smartcam.conformance.camera.results import Check, Item, Question

__all__ = ["CHECKS", "ITEMS", "QUESTIONS"]

ITEMS: tuple[Item, ...] = (
    *session_checks.CHECKS,
    *running_checks.CHECKS,
    *setting_checks.CHECKS,
    *message_checks.CHECKS,
    *questions.QUESTIONS,
    *setting_checks.REBOOT_CHECKS,
    *questions.REBOOT_QUESTIONS,
    *message_checks.LAST_CHECKS,
)
"""Everything."""

CHECKS: tuple[Check, ...] = tuple(item for item in ITEMS if isinstance(item, Check))
"""The checks among them."""

QUESTIONS: tuple[Question, ...] = tuple(item for item in ITEMS if isinstance(item, Question))
"""The questions among them."""
