"""Declare and set the parameters of a node."""

from __future__ import annotations

import asyncio
import inspect
import logging
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._suggestions import did_you_mean
from smartcam.exceptions import ConfigurationError, RosError, SmartCamError
from smartcam.ros2._node.parameter_services import ParameterServices
from smartcam.ros2._node.parameter_values import (
    TYPES,
    ParameterDescription,
    Typed,
    checked_range,
    typed_value,
)

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from smartcam.ros2._node.interface import NodeOfRos

logger: logging.Logger = logging.getLogger("smartcam.ros2")

SET_TIMEOUT = 10.0
"""Seconds that a hook may take, and that a change may wait for earlier changes."""

MAX_VALUE_SIZE = 1 << 16
"""Largest number of characters, bytes or elements of a value."""

MAX_NAME_CHARACTERS = 256
MAX_PARAMETERS = 1024


class _Declared:
    """A declared parameter with its value."""

    __slots__ = ("description", "on_set", "value")

    def __init__(
        self, description: ParameterDescription, value: Typed, on_set: Callable[[Any], Any] | None
    ) -> None:
        self.description, self.value, self.on_set = description, value, on_set

    def checked_value(self, value: object, *, by_node: bool = False) -> Typed:
        """Return a value with its type; ``by_node`` allows it for a read-only parameter.

        Raises:
            ConfigurationError: the value is of another type or out of range, or is read-only.
        """
        name = self.description.name
        if self.description.read_only and not by_node:
            raise ConfigurationError(f"parameter {name!r} cannot be set: it is read-only")
        if value is None or (isinstance(value, Typed) and value.value is None):
            raise ConfigurationError(f"parameter {name!r} cannot be unset: it is {self.value.type}")
        value = typed_value(name, value, self.value.type_number)
        if value.type_number != self.value.type_number:
            raise ConfigurationError(
                f"parameter {name!r} is {self.value.type}, it cannot be set to {value}"
            )
        self._check(value)
        return value

    def _check(self, value: Typed) -> None:
        name, plain = self.description.name, value.value
        if isinstance(plain, str | bytes | tuple) and len(plain) > MAX_VALUE_SIZE:
            raise ConfigurationError(
                f"parameter {name!r}: a value of length {len(plain)}: "
                f"expected {MAX_VALUE_SIZE} at most"
            )
        self.description.check_range(plain)


class _ParameterChange(NamedTuple):
    declared: _Declared
    old: Typed
    new: Typed


class RosParameters:
    """The parameters of a node; other nodes list, get, describe and set them while it is open.

    The first value gives the type of a parameter: ``bool``, ``int``, ``float``, ``str``,
    ``bytes``, or a list of one of the first four; an ``int`` is not accepted for a ``float``.

    Args:
        node: node of the parameters.
        served: whether other nodes can use the parameters.
        timeout: seconds that one ``on_set`` may take, and that a change may wait for earlier ones.
    """

    def __init__(
        self, node: NodeOfRos, *, served: bool = True, timeout: float = SET_TIMEOUT
    ) -> None:
        self._node, self._timeout = node, timeout
        self._declared: dict[str, _Declared] = {}
        self._lock = asyncio.Lock()
        self._setting_task: asyncio.Task[Any] | None = None  # task that sets parameters now
        self._tasks: set[asyncio.Task[Any]] = set()
        self._services = ParameterServices(node, self) if served else None
        self.declare(
            "use_sim_time",
            False,
            description="Whether time is that of the topic /clock.",
            on_set=_refuse_sim_time,
        )

    # ------------------------------------------------------------------ life

    def open(self) -> None:
        """Serve the parameters; the node calls this when it is opened."""
        if self._services is not None:
            self._services.open()

    async def close(self) -> None:
        """Cancel running changes; declared parameters stay. The node calls this."""
        if self._services is not None:
            self._services.close()
        for task in self._tasks:
            task.cancel()
        if self._tasks:
            await asyncio.wait(tuple(self._tasks))

    # ------------------------------------------------------------------ declarations

    def declare(
        self,
        name: str,
        value: object,
        *,
        description: str = "",
        read_only: bool = False,
        minimum: float | None = None,
        maximum: float | None = None,
        step: float | None = None,
        on_set: Callable[[Any], Awaitable[Any] | None] | None = None,
        type: str = "",
    ) -> None:
        """Declare a parameter.

        Args:
            name: name such as ``exposure``, or ``image.width`` in a group.
            value: first value.
            description: explanation for people.
            read_only: whether only :meth:`update` can change the value.
            minimum: least value of a number.
            maximum: greatest value of a number.
            step: step of a number, from ``minimum`` on.
            on_set: function or coroutine function that is called with a new value before it is
                set; it refuses the value by a :class:`~smartcam.SmartCamError`, with its text.
            type: name of the type, such as ``string_array``, for a list without elements.

        Raises:
            ConfigurationError: the parameter is already declared, or value, name, type or range
                is not valid.
        """
        if not 0 < len(name) <= MAX_NAME_CHARACTERS or not name.isprintable():
            raise ConfigurationError(f"parameter {name!r:.80}: expected a name in printable text")
        if name in self._declared:
            raise ConfigurationError(f"parameter {name!r} of {self._node.full_name} exists already")
        if len(self._declared) >= MAX_PARAMETERS:
            raise ConfigurationError(f"{name!r}: expected at most {MAX_PARAMETERS} parameters")
        if type and type not in TYPES[1:]:
            raise ConfigurationError(
                f"parameter {name!r}: type {type!r}: expected one of {', '.join(TYPES[1:])}"
                f"{did_you_mean(type, TYPES)}"
            )
        first = typed_value(name, value, TYPES.index(type) if type else 0)
        if type and first.type != type:
            raise ConfigurationError(f"parameter {name!r}: expected {type}, got {first}")
        bounds = checked_range(name, first.type_number, minimum, maximum, step)
        parameter_description = ParameterDescription(
            name, first.type, description, read_only, *bounds
        )
        declared = _Declared(parameter_description, first, on_set)
        declared.checked_value(first, by_node=True)
        self._declared[name] = declared
        self._notify(new=[name])

    def undeclare(self, name: str) -> None:
        """Remove a parameter.

        Raises:
            ConfigurationError: there is no parameter of this name.
        """
        parameter = self._get_declared(name)
        del self._declared[name]
        self._notify(deleted={name: parameter.value})

    def names(self) -> list[str]:
        """Return the names, in the order of their declaration."""
        return list(self._declared)

    def get(self, name: str) -> Any:
        """Return a value; arrays are tuples.

        Raises:
            ConfigurationError: there is no parameter of this name.
        """
        return self._get_declared(name).value.value

    def describe(self, name: str) -> ParameterDescription:
        """Return the description of a parameter.

        Raises:
            ConfigurationError: there is no parameter of this name.
        """
        return self._get_declared(name).description

    def find(self, name: str) -> Typed | None:
        """Return a value with its type; None if there is no parameter of this name."""
        parameter = self._declared.get(name)
        return None if parameter is None else parameter.value

    def _get_declared(self, name: str) -> _Declared:
        parameter = self._declared.get(name)
        if parameter is None:
            raise ConfigurationError(
                f"parameter {name!r:.80} of {self._node.full_name} is not declared"
                f"{did_you_mean(name[:MAX_NAME_CHARACTERS], self._declared)}"
            )
        return parameter

    # ------------------------------------------------------------------ setting

    def update(self, name: str, value: object) -> None:
        """Change the value of a parameter without ``on_set``, even of a read-only one.

        Raises:
            ConfigurationError: there is no parameter of this name, or it cannot have the value.
        """
        declared = self._get_declared(name)
        new_value = declared.checked_value(value, by_node=True)
        if new_value != declared.value:
            declared.value = new_value
            self._notify(changed=[name])

    async def set(self, name: str, value: object) -> None:
        """Set a parameter as another node would: its ``on_set`` may refuse the value.

        Raises:
            ConfigurationError: there is no parameter of this name, or the value is not valid.
            RosError: its ``on_set`` failed, or earlier changes took too long.
            SmartCamError: its ``on_set`` refused the value.

        Cancellation: the value is unchanged; whether ``on_set`` was carried out is unknown.
        """
        await self.set_all({name: value})

    async def set_all(self, values: Mapping[str, object]) -> None:
        """Set several parameters, or none of them: if one fails, the others are undone.

        Raises:
            ConfigurationError: there is no parameter of a name, or a value is not valid.
            RosError: an ``on_set`` failed, or earlier changes took too long.
            SmartCamError: an ``on_set`` refused a value.

        Cancellation: like a failed ``on_set``.
        """
        if self._setting_task is not None and self._setting_task is asyncio.current_task():
            raise RosError(f"{', '.join(values):.80}: an on_set cannot set parameters")
        try:
            async with asyncio.timeout(self._timeout):
                await self._lock.acquire()
        except TimeoutError:
            raise RosError(
                f"{', '.join(values):.80}: earlier changes took more than {self._timeout:g} s"
            ) from None
        self._setting_task = asyncio.current_task()
        try:
            await self._set_locked(values)
        finally:
            self._setting_task = None
            self._lock.release()

    async def set_shielded(self, values: Mapping[str, object]) -> None:
        """Do :meth:`set_all` to its end, even if the caller is cancelled."""
        task = asyncio.get_running_loop().create_task(self.set_all(values))
        self._tasks.add(task)
        task.add_done_callback(self._on_task_done)
        await asyncio.shield(task)

    def _on_task_done(self, task: asyncio.Task[None]) -> None:
        self._tasks.discard(task)
        if not task.cancelled():
            task.exception()  # the caller may have been cancelled

    async def _set_locked(self, values: Mapping[str, object]) -> None:
        changes = []
        for name, value in values.items():
            declared = self._get_declared(name)
            changes.append(
                _ParameterChange(declared, declared.value, declared.checked_value(value))
            )
        applied: list[_ParameterChange] = []
        try:
            for change in changes:
                await self._call_hook(change.declared, change.new)
                applied.append(change)
        except BaseException as exc:
            await self._undo_changes(applied, exc)
            raise
        for change in changes:
            change.declared.value = change.new
        self._notify(changed=[name for name in values if name in self._declared])

    async def _undo_changes(self, applied: list[_ParameterChange], error: BaseException) -> None:
        """Undo changes; a change that cannot be undone stays, and is published and logged."""
        for change in reversed(applied):
            name = change.declared.description.name
            try:
                await self._call_hook(change.declared, change.old)
            except SmartCamError as exc:
                change.declared.value = change.new
                text = f"parameter {name!r} stays {change.new}: it was not taken back: {exc}"
                logger.error("%s ! %s", self._node.full_name, text)  # noqa: TRY400 - the text has it
                error.add_note(text)
                self._notify(changed=[name])

    async def _call_hook(self, declared: _Declared, value: Typed) -> None:
        """Call the hook with a value.

        Raises:
            RosError: the hook failed, or took too long.
            SmartCamError: the hook refuses.
        """
        if declared.on_set is None:
            return
        name = declared.description.name
        deadline = asyncio.timeout(self._timeout)
        try:
            async with deadline:
                outcome = declared.on_set(value.value)
                if inspect.isawaitable(outcome):
                    await outcome
        except SmartCamError:
            raise
        except Exception as exc:
            if deadline.expired():
                raise RosError(
                    f"parameter {name!r}: no answer within {self._timeout:g} s; whether "
                    f"{value} took effect is unknown"
                ) from exc
            logger.exception("%s ! on_set of parameter %r failed", self._node.full_name, name)
            raise RosError(f"parameter {name!r}: {type(exc).__name__}: {exc!s:.200}") from exc

    def _notify(self, **changes: Any) -> None:
        if self._services is not None:
            self._services.publish_event(**changes)


def _refuse_sim_time(value: bool) -> None:
    if value:
        raise ConfigurationError(
            "parameter 'use_sim_time': this node has the system's time only, expected false"
        )
