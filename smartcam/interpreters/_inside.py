"""Names that other packages of smartcam import from this one; users do not need them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.interpreters._base import (
        AnySpec,
        Spec,
        TypedSpec,
        as_plain_interpreter,
        run_plain,
        run_sequence,
    )
    from smartcam.interpreters._localizations import LocalizationsInterpreter

__all__ = [
    "AnySpec",
    "LocalizationsInterpreter",
    "Spec",
    "TypedSpec",
    "as_plain_interpreter",
    "run_plain",
    "run_sequence",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_base": "Spec AnySpec TypedSpec as_plain_interpreter run_plain run_sequence",
            "_localizations": "LocalizationsInterpreter",
        },
    )
