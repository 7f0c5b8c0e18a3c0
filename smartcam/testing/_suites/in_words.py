"""Failures of the suites as text: a check's name and docstring give the expectation."""

from __future__ import annotations

import functools
import inspect
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable


class ExplainedChecks:
    """Base of the suites: a failed check shows its expectation before the comparison."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        for name, check in list(vars(cls).items()):
            if name.startswith("test_") and inspect.isfunction(check):
                setattr(cls, name, _with_explained_failure(check))


def _with_explained_failure(check: Callable[..., Any]) -> Callable[..., Any]:
    """Return a check whose failure's text begins with the check's name and docstring."""
    words = check.__name__.removeprefix("test_").replace("_", " ")
    text = " ".join((check.__doc__ or "").split())

    @functools.wraps(check)
    def run(*args: Any, **kwargs: Any) -> Any:
        try:
            return check(*args, **kwargs)
        except AssertionError as exc:
            exc.args = (f"expected: {words}. {text}\nfound otherwise: {exc}",)
            raise

    return run
