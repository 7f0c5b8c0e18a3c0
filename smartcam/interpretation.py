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


class Interpreted(NamedTuple):
    """What came of a container: value, sequence number if the layout has one, empty slots."""

    value: Any
    sequence: int | None
    empty_slots: int


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

    def __call__(
        self, container: ResultContainer, endian: int, *, camera: str, number: int, at: datetime
    ) -> Interpreted:
        """Interpret one container.

        Raises:
            InterpretationError: it does not fit.
            WrongApplicationError: the mapping does not know its application.
        """
        interpreter = self._one or self._by_application.get(container.application)
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
