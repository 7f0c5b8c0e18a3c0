"""``table``: the records of a layout as a numpy array."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, Literal

from smartcam.interpreters.base import Interpreter

if TYPE_CHECKING:
    import numpy as np

    from smartcam.interpreters.base import Reader
    from smartcam.layout import Layout

__all__ = ["Table"]


class Table(Interpreter):
    """Gives what :meth:`smartcam.Layout.parse_table` gives; needs a layout."""

    layout_use: ClassVar[Literal["none", "optional", "required"]] = "required"
    layout: Layout  # pyright: ignore[reportIncompatibleVariableOverride]  never None here

    def interpret(self, reader: Reader) -> np.ndarray[tuple[int], np.dtype[np.void]]:
        """Return the records as a structured array of one dimension, read-only.

        Raises:
            InterpretationError: the bytes do not fit the layout.
        """
        return self.layout.parse_table(reader.data, reader.context.byte_order)
