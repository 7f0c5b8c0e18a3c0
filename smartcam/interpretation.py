"""From a result container to a :class:`~smartcam.models.Result`: which interpreter, and running it.

``interpret_as`` is one specification for whatever comes, or a mapping from application id to one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.exceptions import ConfigurationError, InterpretationError, WrongApplicationError
from smartcam.interpreters.base import Context, Interpreter, Reader, resolve, run, run_sequence

if TYPE_CHECKING:
    from datetime import datetime

    from smartcam.models import ByteOrder
    from smartcam.protocols.messages import ResultContainer

__all__ = ["Interpretation", "byte_order"]


def byte_order(endian: int) -> ByteOrder:
    """Return the byte order that a status' endian field tells.

    Source: 0 little endian (SC manual p. 30, published), 1 big endian (inferred).

    Raises:
        InterpretationError: any other value.
    """
    if endian == 0:
        return "little"
    if endian == 1:
        return "big"
    raise InterpretationError(
        f"the camera's endian field is {endian}; 0 (little) or 1 (big) was expected",
        field="endian",
        expected=(0, 1),
        got=endian,
    )


MAX_NUMBER = (1 << 31) - 1
"""Largest sequence number of ours: an int32 in the container holds it."""


class Interpreted(NamedTuple):
    """What came of a container: value, sequence number if the layout has one, empty slots."""

    value: Any
    sequence: int | None
    empty_slots: int


class Numbering(NamedTuple):
    """How a layout carries the sequence number.

    Attributes:
        highest: the largest number that its field holds, at most 2^31 - 1.
        always: whether each container has it; not where it stands in a record that may be missing.
    """

    highest: int
    always: bool


class Interpretation:
    """How to read result containers; resolved once, used for every result.

    Args:
        spec: what ``interpret_as`` accepts.
        lenient: any non-zero byte is a true bool.
        y_down: the camera's y axis points down.

    Raises:
        ConfigurationError: the specification is wrong (a layout text with the position).
    """

    def __init__(self, spec: Any, *, lenient: bool, y_down: bool) -> None:
        self._lenient = lenient
        self._y_down = y_down
        self._one: Interpreter | None = None
        self._by_application: dict[int, Interpreter] = {}
        if hasattr(spec, "items"):
            for application, one in spec.items():
                if not isinstance(application, int):
                    raise ConfigurationError(
                        f"interpret_as: a mapping goes from application id to a specification; "
                        f"{application!r} is no id"
                    )
                self._by_application[application] = resolve(one, lenient=lenient)
        else:
            self._one = resolve(spec, lenient=lenient)

    @property
    def by_application(self) -> bool:
        """Whether each application has its own interpreter."""
        return self._one is None

    def numbering(self, application: int | None) -> Numbering | None:
        """Return how this application's containers carry the sequence number, None if not."""
        interpreter = self._interpreter(application)
        layout = interpreter.layout if interpreter is not None else None
        field = layout.sequence_field if layout is not None else None
        if layout is None or field is None or field.wire.high is None:
            return None
        always = field in layout.head or layout.repeat is None
        return Numbering(min(field.wire.high, MAX_NUMBER), always)

    def number(self, container: ResultContainer, endian: int) -> int | None:
        """Return a container's sequence number, None where it has none or does not fit."""
        interpreter = self._interpreter(container.application)
        if interpreter is None or interpreter.layout is None:
            return None
        try:
            return interpreter.layout.sequence(container.data, byte_order(endian))
        except InterpretationError:
            return None

    def _interpreter(self, application: int | None) -> Interpreter | None:
        if self._one is not None or application is None:
            return self._one
        return self._by_application.get(application)

    def __call__(
        self, container: ResultContainer, endian: int, *, camera: str, number: int, at: datetime
    ) -> Interpreted:
        """Interpret one container.

        Raises:
            InterpretationError: it does not fit.
            WrongApplicationError: the mapping does not know its application.
        """
        interpreter = self._interpreter(container.application)
        if interpreter is None:
            known = sorted(self._by_application)
            raise WrongApplicationError(
                f"a result of application {container.application} came; interpret_as knows {known}",
                expected=known,
                got=container.application,
            )
        context = Context(
            camera=camera,
            application=container.application,
            number=number,
            received_at=at,
            byte_order=byte_order(endian),
            y_down=self._y_down,
            lenient=self._lenient,
        )
        reader = Reader(container.data, context, interpreter.layout)
        value = run(interpreter, reader)
        return Interpreted(value, run_sequence(interpreter, reader), context.empty_slots)
