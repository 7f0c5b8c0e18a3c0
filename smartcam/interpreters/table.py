"""``table``: the records of a layout as a numpy array."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from smartcam.interpreters.base import PlainInterpreter

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from smartcam.interpreters.base import Context
    from smartcam.layout import Layout

__all__ = ["Table"]


class Table(PlainInterpreter):
    """Gives what :meth:`smartcam.Layout.parse_table` gives; needs a layout."""

    layout_use: ClassVar[Literal["none", "optional", "required"]] = "required"
    layout: Layout  # pyright: ignore[reportIncompatibleVariableOverride]  never None here

    def read(self, data: bytes, context: Context) -> np.ndarray[tuple[int], np.dtype[np.void]]:
        """Return the records as a structured array of one dimension, read-only.

        Raises:
            InterpretationError: the bytes do not fit the layout.
        """
        return self.layout.parse_table(data, context.byte_order)

    def read_all(
        self, containers: Sequence[bytes], context: Context
    ) -> list[np.ndarray[tuple[int], np.dtype[np.void]]]:
        """Return a table for each container."""
        return self.layout.parse_tables(containers, context.byte_order)
