"""``record``: what a layout says, as a record or a list of records."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal

from smartcam.interpreters.base import PlainInterpreter

if TYPE_CHECKING:
    from smartcam.interpreters.base import Context
    from smartcam.layout import Layout

__all__ = ["Record"]


class Record(PlainInterpreter):
    """Gives what :meth:`smartcam.Layout.parse` gives; needs a layout."""

    layout_use: ClassVar[Literal["none", "optional", "required"]] = "required"
    layout: Layout  # pyright: ignore[reportIncompatibleVariableOverride]  never None here

    def read(self, data: bytes, context: Context) -> Any:
        """Return the record, or the list of records.

        Raises:
            InterpretationError: the bytes do not fit the layout.
        """
        return self.layout.parse(data, context.byte_order)
