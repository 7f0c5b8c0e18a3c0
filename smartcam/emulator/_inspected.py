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
        input: input data of the trigger; empty if none was ever given.
    """

    application: int
    number: int
    input: bytes


class Inspector(ABC):
    """Takes a picture for a run of a camera, and inspects it.

    The camera calls it in the event loop's thread, for one run at a time.
    """

    @abstractmethod
    def begin(
        self,
        order: InspectionOrder,
        seen: Callable[[], None],
        done: Callable[[Values | None], None],
    ) -> None:
        """Begin an inspection of the first picture that is exposed from now on.

        Args:
            order: the run.
            seen: function that is called when the picture is there.
            done: function that is called with the values of the application's layout; None if the
                inspection failed and there is no result.

        Both are called in the event loop's thread, later and not from inside this call. After
        :meth:`cancel` neither is called.
        """

    @abstractmethod
    def cancel(self) -> None:
        """Give up the running inspection; do nothing without one."""


class InspectedApplication(Application):
    """An application whose values an inspector finds in a picture."""

    model_config: ClassVar[ConfigDict] = ConfigDict(arbitrary_types_allowed=True)

    load_time: Seconds = Field(
        default=0.01, description="seconds that a switch to it takes, in which it is BUSY"
    )
    inspector: Inspector = Field(description="the program that inspects the pictures")

    @property
    def period(self) -> int | None:
        """No common container: each run makes its own."""
        return None

    @model_validator(mode="after")
    def _check(self) -> InspectedApplication:
        if self.layout is None:
            raise ValueError("an inspected application needs a layout")
        return self
