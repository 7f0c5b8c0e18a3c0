"""Grids whose cells run the same lines: one test that goes through them all."""

from __future__ import annotations

import functools
import inspect
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

__all__ = ["over"]


def over(
    names: str, cells: Iterable[Any], label: Callable[[Any], object] = str
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Run a test for each cell; a failure names its cell.

    Like ``pytest.mark.parametrize``, but one test and not thousands.

    Args:
        names: of the arguments that a cell gives, with commas.
        cells: values, tuples where there are several names.
        label: what a value is called.
    """
    keys, grid = names.split(", "), list(cells)
    assert grid

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(test)
        def run(**given: Any) -> None:
            for cell in grid:
                values = cell if len(keys) > 1 else (cell,)
                try:
                    test(**dict(zip(keys, values, strict=True)), **given)
                except BaseException as exc:
                    exc.add_note(f"{names}: {', '.join(str(label(value)) for value in values)}")
                    raise

        signature = inspect.signature(test)
        others = [one for name, one in signature.parameters.items() if name not in keys]
        run.__signature__ = signature.replace(parameters=others)  # type: ignore[attr-defined]
        del run.__wrapped__  # pytest asks it for the arguments
        return run

    return decorate
