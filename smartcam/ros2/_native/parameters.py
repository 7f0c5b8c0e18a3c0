"""Parameters of a node of rclpy: ROS keeps and serves them, this module calls their hooks."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextvars
import logging
import threading
from typing import TYPE_CHECKING, Any

from smartcam.exceptions import ConfigurationError, RosError, SmartCamError
from smartcam.ros2._native.installed import rclpy, rclpy_class, to_ros
from smartcam.ros2._node.parameter_services import reason_text
from smartcam.ros2._node.parameter_values import decode_value
from smartcam.ros2._node.parameters import SET_TIMEOUT, RosParameters

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from smartcam.ros2._native.node import NativeNode
    from smartcam.ros2._node.parameter_values import Typed

logger: logging.Logger = logging.getLogger("smartcam.ros2")

SIM_TIME = "use_sim_time"
"""A parameter that rclpy declares itself."""

HOOK_TIMEOUT = 2 * SET_TIMEOUT + 1.0
"""Seconds for which a thread of rclpy waits for the hooks of a set, and for earlier sets to end."""

_asked_by_ros: contextvars.ContextVar[bool] = contextvars.ContextVar("asked_by_ros", default=False)


class NativeParameters(RosParameters):
    """The parameters of a node of rclpy, which declares, serves and publishes them.

    When another node sets a parameter, its hook is called before rclpy takes the value, and may
    refuse. A value from the command line or a parameter file is applied at the declaration.

    Args:
        node: node that has the parameters.
    """

    def __init__(self, node: NativeNode) -> None:
        super().__init__(node, served=False)
        self.undeclare(SIM_TIME)
        self._native = node
        self._rclpy_node: Any = None
        self._own_change = threading.local()  # set while this object sets a value in rclpy

    def open(self) -> None:
        """Declare the parameters in ROS."""
        self._rclpy_node = self._native.rclpy_node
        self._rclpy_node.add_on_set_parameters_callback(self._on_set)
        for name in self.names():
            self._declare_in_ros(name)

    async def close(self) -> None:
        """Cancel running sets; the declarations stay."""
        self._rclpy_node = None
        await super().close()

    # ------------------------------------------------------------------ changes here, told to ROS

    def _notify(self, **changes: Any) -> None:
        """Add, change or delete parameters in ROS."""
        if getattr(self, "_rclpy_node", None) is None:
            return
        for name in changes.get("new", ()):
            self._declare_in_ros(name)
        changed = changes.get("changed", ())
        if changed and not _asked_by_ros.get():
            self._change_in_ros(
                lambda: self._rclpy_node.set_parameters(list(map(self._rclpy_parameter, changed)))
            )
        for name in changes.get("deleted", ()):
            if not self._rclpy_node.describe_parameter(name).read_only:  # rclpy keeps those
                self._change_in_ros(lambda name=name: self._rclpy_node.undeclare_parameter(name))

    def _change_in_ros(self, change: Any) -> Any:
        self._own_change.now = True
        try:
            return change()
        except Exception as exc:  # noqa: BLE001 - rclpy may raise any error
            logger.warning("%s ! a parameter: %s", self._native.full_name, exc)
        finally:
            self._own_change.now = False

    def _declare_in_ros(self, name: str) -> None:
        description = self.describe(name)
        message_type = self._native.types.message("rcl_interfaces/msg/ParameterDescriptor")
        descriptor = to_ros(message_type, description.encode(), rclpy_class(message_type.name))
        parameter = self._rclpy_parameter(name)
        self._own_change.now = True
        try:
            declared = self._rclpy_node.declare_parameter(
                name, parameter.value, descriptor, ignore_override=description.read_only
            )
        except Exception as exc:
            del self._declared[name]
            raise ConfigurationError(f"parameter {name!r}: {exc!s:.300}") from exc
        finally:
            self._own_change.now = False
        if declared.value != parameter.value:
            self._apply_override(name, decode_value(declared.get_parameter_value()))

    def _apply_override(self, name: str, value: Typed) -> None:
        """Apply a parameter's value from the command line or a parameter file."""

        async def apply() -> None:
            _asked_by_ros.set(True)
            try:
                await self.set_shielded({name: value})
            except SmartCamError as exc:
                logger.warning("%s ! parameter %s: %s", self._native.full_name, name, exc)
                _asked_by_ros.set(False)
                self._notify(changed=[name])

        task = asyncio.get_running_loop().create_task(apply())
        self._tasks.add(task)
        task.add_done_callback(self._on_task_done)

    def _rclpy_parameter(self, name: str) -> Any:
        value = self._get_declared(name).value
        plain: Any = value.value
        if isinstance(plain, bytes):
            plain = [bytes([byte]) for byte in plain]
        parameter_class = rclpy("parameter").Parameter
        plain = list(plain) if isinstance(plain, tuple) else plain
        return parameter_class(name, parameter_class.Type(value.type_number), plain)

    # ------------------------------------------------------------------ changes by other nodes

    def _on_set(self, parameters: Sequence[Any]) -> Any:
        """Accept or refuse values; called in the thread that sets them, which waits for hooks."""
        result = rclpy_class("rcl_interfaces/msg/SetParametersResult")
        if getattr(self._own_change, "now", False):
            return result(successful=True)
        try:
            self._set_in_event_loop({parameter.name: parameter for parameter in parameters})
        except concurrent.futures.CancelledError:
            return result(successful=False, reason=f"{self._native.full_name} is closed")
        except TimeoutError:
            text = f"no answer within {HOOK_TIMEOUT:g} s; whether it took effect is unknown"
            return result(successful=False, reason=text)
        except SmartCamError as exc:
            return result(successful=False, reason=reason_text(exc))
        except Exception as exc:
            logger.exception("%s ! parameters", self._native.full_name)
            return result(successful=False, reason=f"{type(exc).__name__}: {exc!s:.300}")
        return result(successful=True)

    def _set_in_event_loop(self, parameters: Mapping[str, Any]) -> None:
        values = {
            name: decode_value(value.get_parameter_value())
            for name, value in parameters.items()
            if self.find(name) is not None  # others are rclpy's own
        }
        if not values:
            return

        async def set_values() -> None:
            task = asyncio.current_task()
            if self._rclpy_node is None or task is None:
                raise RosError(f"{self._native.full_name} is closed")
            self._tasks.add(task)  # close() cancels it
            task.add_done_callback(self._on_task_done)
            _asked_by_ros.set(True)
            await self.set_all(values)

        future = self._native.submit(set_values)
        try:
            future.result(HOOK_TIMEOUT)
        finally:
            future.cancel()
