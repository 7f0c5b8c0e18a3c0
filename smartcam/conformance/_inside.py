"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.conformance._pytest_options import add_options, terminal_summary

__all__ = [
    "add_options",
    "terminal_summary",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_pytest_options": "add_options terminal_summary",
        },
    )
