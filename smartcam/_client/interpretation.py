"""Make a :class:`~smartcam.Result` from a result container: choose the interpreter, and run it.

``interpret_as`` is one specification for all containers, or a mapping from application ids to
specifications. A ``calibration``, one for all applications or one for each, is applied to the
interpreter's value, which then consists of poses in the robot's frame.
"""

from __future__ import annotations

import functools
import inspect
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, cast

from smartcam._arguments import check_application, excerpt
from smartcam._user_code import ENDS_PROGRAM, text_of
from smartcam.exceptions import (
    CalibrationError,
    ConfigurationError,
    InterpretationError,
    WrongApplicationError,
)
from smartcam.interpreters import Context, Interpreter, PlainInterpreter, Reader, resolve, run
from smartcam.interpreters._inside import as_plain_interpreter, run_plain, run_sequence
from smartcam.layout._inside import UNITS, pack_texts
from smartcam.models import Localization
from smartcam.registry import INTERPRETERS

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from datetime import datetime

    from smartcam.camera import Camera
    from smartcam.layout import Layout
    from smartcam.models import ByteOrder, Calibration
    from smartcam.protocols.messages import ResultContainer

_BYTE_ORDERS: dict[int, ByteOrder] = {0: "little", 1: "big"}


def byte_order(endian: int) -> ByteOrder:
    """Return the byte order in a status' endian field.

    Source: 0 little endian (SC manual p. 30, published), 1 big endian (inferred).

    Raises:
        InterpretationError: any other value.
    """
    if endian in _BYTE_ORDERS:
        return _BYTE_ORDERS[endian]
    raise InterpretationError(
        f"the camera's endian field is {endian}; 0 (little) or 1 (big) was expected",
        field="endian",
        expected=(0, 1),
        got=endian,
    )


# faster than a NamedTuple's own constructor; the cast gives it a type
new_tuple = cast("Callable[..., Any]", tuple.__new__)  # pyright: ignore[reportUnknownMemberType]

MAX_NUMBER = (1 << 31) - 1
"""Largest sequence number of a trigger: it fits into an int32 in the container."""


Interpreted: TypeAlias = tuple[Any, int | None, int]
"""A container's value, its sequence number if the layout has one, and its number of empty slots."""


class Numbering(NamedTuple):
    """The form of the sequence number in a layout.

    Attributes:
        highest: the largest number that the field holds, at most 2^31 - 1.
        always: whether each container has the number, not only those with records.
    """

    highest: int
    always: bool


class Interpretation:
    """The interpreters of result containers; resolved once, used for every result.

    Args:
        spec: a value of ``interpret_as``.
        lenient: whether any non-zero byte counts as True in a bool.
        y_down: whether the camera's y axis points down.
        calibration: a value of ``calibration``.
        strict_calibration: True if the calibration was given together with ``spec``. Then a
            ``spec`` whose values never are localizations is an error; if False, the calibration is
            not applied to such values.

    Attributes:
        by_application: whether each application has its own interpreter.

    Raises:
        ConfigurationError: the specification is wrong (a layout text with the position), or the
            calibration is not valid, or was made with the other direction of y, or cannot apply to
            the specification's values.
    """

    def __init__(
        self,
        spec: Any,
        *,
        lenient: bool,
        y_down: bool,
        calibration: Any = None,
        strict_calibration: bool = True,
    ) -> None:
        self._lenient = lenient
        self._y_down = y_down
        self._plain_context = Context(y_down=y_down, lenient=lenient)
        self._endian = 0
        self._setup_of_all: _ApplicationSetup | None = None
        self._by_application: dict[int, _ApplicationSetup] = {}
        if hasattr(spec, "items"):
            for application, application_spec in spec.items():
                if not isinstance(application, int):
                    raise ConfigurationError(
                        f"interpret_as: a mapping goes from application id to a specification; "
                        f"{excerpt(application)} is no id"
                    )
                self._by_application[application] = _make_setup(
                    resolve(application_spec, lenient=lenient), strict_calibration
                )
        else:
            self._setup_of_all = (
                _raw_setup(strict_calibration)
                if spec is None
                else _make_setup(resolve(spec, lenient=lenient), strict_calibration)
            )
        self._calibrations = None if calibration is None else _Calibrations(calibration, y_down)
        if self._calibrations is not None and strict_calibration:
            if self._setup_of_all is not None:
                self._calibrations.check(None, self._setup_of_all.interpreter)
            for application, setup in self._by_application.items():
                self._calibrations.check(application, setup.interpreter)
        self.by_application: bool = self._setup_of_all is None

    @property
    def layout(self) -> Layout | None:
        """Layout of every container; None if there is none, or each application has its own."""
        return None if self._setup_of_all is None else self._setup_of_all.interpreter.layout

    @property
    def applications(self) -> tuple[int, ...]:
        """The applications that have interpreters of their own."""
        return tuple(self._by_application)

    def interpreter(self, application: int | None) -> Interpreter | None:
        """Return the interpreter of an application; None for one that is not known."""
        setup = self._setup_for(application)
        return None if setup is None else setup.interpreter

    def numbering(self, application: int | None) -> Numbering | None:
        """Return the form of an application's sequence numbers; None if it has none."""
        setup = self._setup_of_all or self._setup_for(application)
        return setup.numbering if setup is not None else None

    def numbered_layouts(self) -> str | dict[int, str] | None:
        """Return the layouts with a sequence number, in the form of ``interpret_as``."""
        if self._setup_of_all is not None:
            return _numbered_layout_text(self._setup_of_all)
        texts = {key: _numbered_layout_text(setup) for key, setup in self._by_application.items()}
        return {key: text for key, text in texts.items() if text is not None} or None

    def sequence_number(self, container: ResultContainer, endian: int) -> int | None:
        """Return a container's sequence number; None if the layout has none or does not fit."""
        setup = self._setup_for(container.application)
        if setup is None or setup.interpreter.layout is None:
            return None
        try:
            return setup.interpreter.layout.sequence(container.data, byte_order(endian))
        except InterpretationError:
            return None

    def _setup_for(self, application: int | None) -> _ApplicationSetup | None:
        if self._setup_of_all is not None or application is None:
            return self._setup_of_all
        return self._by_application.get(application)

    def _known_setup(self, application: int) -> _ApplicationSetup:
        setup = self._setup_for(application)
        if setup is None:
            known = sorted(self._by_application)
            raise WrongApplicationError(
                f"a result of application {application} came; interpret_as knows {known}",
                expected=known,
                got=application,
            )
        return setup

    def __call__(
        self, container: ResultContainer, endian: int, *, camera: str, number: int, at: datetime
    ) -> Interpreted:
        """Interpret one container.

        Raises:
            InterpretationError: the container does not fit, or the calibration cannot turn its
                value into poses of the robot; then the calibration's error is chained.
            WrongApplicationError: a mapping does not know its application.
        """
        setup = self._setup_of_all or self._known_setup(container.application)
        interpreter, plain_interpreter = setup.interpreter, setup.plain_interpreter
        data = container.data
        if container.cells is not None or container.fault is not None:
            data = _from_cells(container, interpreter)
        if plain_interpreter is not None and not setup.sequenced:
            context = self._context(container.application, endian, camera, number, at)
            value = run_plain(plain_interpreter, data, context)
            if self._calibrations is not None and setup.calibrated:
                value = self._calibrations.apply(value, container.application)
            return value, None, context.empty_slots
        order = byte_order(endian)
        context = Context(
            camera, container.application, number, at, order, self._y_down, self._lenient
        )
        reader = Reader(data, context, interpreter.layout)
        value = run(interpreter, reader)
        if self._calibrations is not None and setup.calibrated:
            value = self._calibrations.apply(value, container.application)
        sequence = run_sequence(interpreter, reader) if setup.sequenced else None
        return value, sequence, context.empty_slots

    def _context(
        self, application: int, endian: int, camera: str, number: int, at: datetime
    ) -> Context:
        """Return the context for a plain interpreter, a shared object."""
        context = self._plain_context
        if endian != self._endian:
            context.byte_order, self._endian = byte_order(endian), endian
        context.camera, context.application = camera, application
        context.number, context.received_at = number, at
        context.empty_slots = 0
        return context

    def burst(
        self,
        application: int,
        payloads: list[bytes],
        endian: int,
        *,
        camera: str,
        number: int,
        at: datetime,
    ) -> tuple[Sequence[Any], int] | None:
        """Return the values of several containers that arrived together, and their empty slots.

        Return None if the containers must be interpreted singly: the interpreter uses a Reader, a
        sequence number must be read, or a container does not fit.
        """
        setup = self._setup_for(application)
        if (
            setup is None
            or setup.plain_interpreter is None
            or setup.sequenced
            or endian not in _BYTE_ORDERS
        ):
            return None
        context = self._context(application, endian, camera, number, at)
        try:
            values = setup.plain_interpreter.read_all(payloads, context)
            complete = len(values) == len(payloads)
            if self._calibrations is not None and setup.calibrated:
                # one by one, so that a value does not depend on the others in its last bits
                values = [self._calibrations.apply(value, application) for value in values]
        except ENDS_PROGRAM:
            raise
        except BaseException:  # noqa: BLE001 - the caller interprets each one, and gets the error
            return None
        return (values, context.empty_slots) if complete else None


class _Calibrations:
    """The calibrations that are applied to each application's values.

    Args:
        given: a value of ``calibration``, not None.
        y_down: whether the camera's y axis points down.

    Raises:
        ConfigurationError: the calibration is no calibration, and no mapping from application ids
            to calibrations; or it was made with the other direction of y.
    """

    def __init__(self, given: Any, y_down: bool) -> None:
        self._shared: Calibration | None = None
        self._by_application: dict[int, Calibration | None] | None = None
        if hasattr(given, "to_robot") or not hasattr(given, "items"):
            self._shared = _checked_calibration(given, y_down)
            return
        self._by_application = {}
        for application, calibration in given.items():
            number = check_application(application, "calibration: application")
            self._by_application[number] = (
                None if calibration is None else _checked_calibration(calibration, y_down)
            )

    def check(self, application: int | None, interpreter: Interpreter) -> None:
        """Raise if the calibration can apply to no value of an interpreter.

        Args:
            application: id of the application whose results are read; None: any.
            interpreter: interpreter of these results.

        Raises:
            ConfigurationError: the calibration applies to no value.
        """
        given, known = [self._shared], self._by_application
        of = "" if application is None else f" of application {application}"
        if known is not None:
            if application is not None and application not in known:
                raise ConfigurationError(
                    f"calibration: expected a calibration{of}, or None to leave its values as they "
                    f"are; "
                    f"the mapping has {sorted(known)}"
                )
            given = [*known.values()] if application is None else [known[application]]
        name = name_if_poseless(interpreter)
        if name is not None and None not in given:
            raise ConfigurationError(
                f"calibration: expected results{of} to be localizations, as with "
                f"interpret_as='localizations', got the interpreter {name!r}; a mapping with None "
                "for an application leaves its values as they are"
            )

    def apply(self, value: object, application: int) -> Any:
        """Return localizations in the robot's frame; without a calibration, the value unchanged.

        Raises:
            InterpretationError: the value is no list of localizations, or the calibration failed,
                with the cause chained.
            WrongApplicationError: the mapping does not know the application.
        """
        calibration = self._calibration_for(application)
        if calibration is None:
            return value
        parts = localizations_of(value)
        if parts is None:
            raise InterpretationError(
                f"calibration: expected a list of localizations of application {application}, "
                f"got {type(value).__name__}",
                expected="a list of localizations",
                got=type(value).__name__,
            )
        try:
            transformed: object = calibration.to_robot(parts)
        except CalibrationError as exc:
            raise InterpretationError(
                f"calibration: {exc}", expected=exc.expected, got=exc.got
            ) from exc
        except ENDS_PROGRAM:
            raise
        except BaseException as exc:
            text = text_of(exc)
            raise InterpretationError(f"the calibration failed with {text}", got=text) from exc
        calibrated = localizations_of(transformed)
        if calibrated is None or len(calibrated) != len(parts):
            actual = type(transformed).__name__ if calibrated is None else len(calibrated)
            raise InterpretationError(
                f"calibration: expected to_robot to return {len(parts)} localizations, "
                f"got {actual}",
                expected=len(parts),
                got=actual,
            )
        return calibrated

    def _calibration_for(self, application: int) -> Calibration | None:
        known = self._by_application
        if known is None:
            return self._shared
        if application not in known:
            raise WrongApplicationError(
                f"a result of application {application} came; calibration knows {sorted(known)}",
                expected=sorted(known),
                got=application,
            )
        return known[application]


def _checked_calibration(given: Any, y_down: bool) -> Calibration:
    """Return an object that was given as a calibration, if it is one.

    Raises:
        ConfigurationError: the calibration is not valid, or would mirror poses.
    """
    method = getattr(given, "to_robot", None)
    if isinstance(given, type) or not callable(method) or inspect.iscoroutinefunction(method):
        raise ConfigurationError(
            "calibration: expected an object with a method to_robot(localizations) that is not "
            f"async, such as PlaneCalibration.load(FILE) gives, got {excerpt(given)}"
        )
    own_y_down: object = getattr(given, "y_down", None)
    if own_y_down is not None and own_y_down != y_down:
        raise ConfigurationError(
            f"calibration: it was made with y_down={own_y_down}, so with y_down={y_down} its poses "
            f"would be mirrored; expected y_down={own_y_down}"
        )
    return cast("Calibration", given)


def localizations_of(value: object) -> list[Localization] | None:
    """Return ``value`` if it is a list of only localizations, else None."""
    if not isinstance(value, list):
        return None
    parts: list[Any] = value
    return parts if all(isinstance(part, Localization) for part in parts) else None


_WITHOUT_POSES = ("raw", "record", "strings50", "table")
"""Built-in interpreters whose values never are localizations."""


def name_if_poseless(interpreter: Interpreter) -> str | None:
    """Return the interpreter's name if its values never are localizations, else None."""
    # exactly the built-in types, since a subclass may return any value
    names = (name for name in _WITHOUT_POSES if type(interpreter) is INTERPRETERS.load(name))
    return next(names, None)


def camera_interpreter(camera: Camera[Any], application: int | None) -> Interpreter | None:
    """Return the interpreter of a camera's results; None for an application that is not known."""
    return camera._default.interpreter(application)  # noqa: SLF001 - smartcam's own


def has_pixel_positions(interpreter: Interpreter | None) -> bool:
    """Return True if an interpreter's positions are in pixels, not in lengths."""
    layout = None if interpreter is None else interpreter.layout
    return layout is not None and any(
        field.unit is not None and UNITS[field.unit].quantity == "pixels"
        for field in layout.fields
        if field.name in {"x", "y", "z"}
    )


def _from_cells(container: ResultContainer, interpreter: Interpreter) -> bytes:
    """Return a container's bytes; values that are texts are packed in the form of the layout."""
    if container.fault is not None:
        raise InterpretationError(container.fault)
    if interpreter.layout is None or container.cells is None:
        return container.data
    return pack_texts(interpreter.layout, container.cells)


@dataclass(frozen=True, slots=True)
class _ApplicationSetup:
    """The way in which one application's containers are interpreted.

    Attributes:
        interpreter: interpreter of the containers.
        plain_interpreter: the interpreter if it needs only the bytes, else None.
        sequenced: whether the interpreter may report a sequence number.
        numbering: form of the sequence number in the layout; None if it has none.
        calibrated: whether values pass through the calibration, if there is one.
    """

    interpreter: Interpreter
    plain_interpreter: PlainInterpreter | None
    sequenced: bool
    numbering: Numbering | None
    calibrated: bool


@functools.cache
def _raw_setup(strict_calibration: bool) -> _ApplicationSetup:
    """Return the setup for raw bytes, the same for all clients without a specification."""
    return _make_setup(resolve(None), strict_calibration)


def _numbered_layout_text(setup: _ApplicationSetup) -> str | None:
    layout = setup.interpreter.layout
    return None if setup.numbering is None or layout is None else layout.text


def _make_setup(interpreter: Interpreter, strict_calibration: bool) -> _ApplicationSetup:
    layout = interpreter.layout
    sequenced = type(interpreter).sequence is not Interpreter.sequence
    field = layout.sequence_field if layout is not None else None
    numbering = None
    if layout is not None and field is not None and field.wire.high is not None:
        always = field in layout.head or layout.repeat is None
        numbering = Numbering(min(field.wire.high, MAX_NUMBER), always)
    return _ApplicationSetup(
        interpreter,
        as_plain_interpreter(interpreter),
        sequenced or field is not None,
        numbering,
        strict_calibration or name_if_poseless(interpreter) is None,
    )
