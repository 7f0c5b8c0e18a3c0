"""Applications of an emulated camera whose results come from inspected pictures."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from pydantic import ConfigDict, Field, model_validator

from smartcam.emulator._application import Application
from smartcam.emulator._data import Seconds  # noqa: TC001 - pydantic does

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.emulator._generators import Values


class InspectionOrder(NamedTuple):
    """An inspection for a run of a camera.

    Attributes:
        application: id of the program to run.
        number: sequence number of the run.
        input: input data of the trigger; empty if none was ever sent.
    """

    application: int
    number: int
    input: bytes


class Inspector(ABC):
    """An object that takes and inspects a picture for a run of a camera.

    The camera calls it in the event loop's thread, for one run at a time.
    """

    @abstractmethod
    def begin(
        self,
        order: InspectionOrder,
        on_exposed: Callable[[], None],
        on_done: Callable[[Values | None], None],
    ) -> None:
        """Begin an inspection of the next exposed picture.

        Args:
            order: the run.
            on_exposed: function that is called when the picture was taken.
            on_done: function that is called with the values of the application's layout; None if
                the inspection failed and there is no result.

        Both functions are called in the event loop's thread, after this call has returned, and not
        after :meth:`cancel`.
        """

    @abstractmethod
    def cancel(self) -> None:
        """Abandon the running inspection, if there is one."""


class InspectedApplication(Application):
    """An application whose values an inspector finds in a picture."""

    model_config: ClassVar[ConfigDict] = ConfigDict(arbitrary_types_allowed=True)

    load_time: Seconds = Field(
        default=0.01, description="seconds of a switch to it, in which the camera is BUSY"
    )
    inspector: Inspector = Field(description="the program that inspects the pictures")

    @property
    def repeat_after(self) -> int | None:
        """None: results do not repeat, since each run inspects a picture."""
        return None

    @model_validator(mode="after")
    def _check(self) -> InspectedApplication:
        if self.layout is None:
            raise ValueError("an inspected application needs a layout")
        return self
