"""Change the settings of the device that delivers the frames, by parameters of the camera's node.

The controls of a V4L2 device have the names and types that v4l2_camera gives them; the features of
any other device have their own names, in lower case with underscores.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
from functools import partial
from typing import TYPE_CHECKING, Any

from smartcam.exceptions import ConfigurationError, SmartCamError, UnsupportedError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.frames import FrameSource

logger: logging.Logger = logging.getLogger("smartcam.ros2")

REFRESH_DELAY = 0.2
"""Seconds between setting a feature and reading all features again."""


class CameraControls:
    """Declares a parameter for each control or feature of a device, such as ``brightness``.

    A boolean control is ``bool``, any other ``int``, within the control's range. A feature that can
    be set is ``bool``, ``int``, ``float``, or ``str`` for one of a list of names; the description
    has its range, since other features may change it. Setting the parameter sets the device; if the
    device refuses a value, the parameter is refused with the device's error. After each set the
    parameters of all features are read from the device again.

    Args:
        node: node of ROS 2.
        get_source: function that returns the open source of the frames.
    """

    def __init__(self, node: Any, get_source: Callable[[], Awaitable[FrameSource]]) -> None:
        self._node, self._get_source = node, get_source
        self._declared: list[str] = []
        self._features: dict[str, str] = {}  # feature by parameter
        self._refresh_task: asyncio.Task[None] | None = None
        self._declare_task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Ask the device for its controls, and declare them."""
        self._declare_task = asyncio.get_running_loop().create_task(
            self._declare_all(), name=f"controls of {self._node.full_name}"
        )

    async def close(self) -> None:
        """Undeclare the parameters. Idempotent."""
        tasks = [task for task in (self._declare_task, self._refresh_task) if task is not None]
        self._declare_task = self._refresh_task = None
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)
        self._features = {}
        declared, self._declared = self._declared, []
        for name in declared:
            with contextlib.suppress(ConfigurationError):  # another program has undeclared it
                self._node.parameters.undeclare(name)

    async def _declare_all(self) -> None:
        try:
            source = await self._get_source()
            driver: Any = source.driver
            if not hasattr(driver, "set_control"):
                await self._declare_features(source)
                return
            controls = await driver.controls()
        except UnsupportedError:  # a source without controls
            return
        except SmartCamError as exc:
            logger.warning(
                "%s ! its controls are not available as parameters: %s", self._node.full_name, exc
            )
            return
        for control in controls.values():
            if control.kind != "button" and control.value is not None:
                self._declare(driver, control)

    async def _declare_features(self, source: FrameSource) -> None:
        for feature in (await source.features.describe()).values():
            if feature.access != "rw" or feature.value is None:
                continue
            name = _snake_case(feature.name)
            more = f" {feature.description}" if feature.description else ""
            try:
                self._node.parameters.declare(
                    name,
                    float(feature.value) if feature.kind == "float" else feature.value,
                    description=f"{feature.name}: {feature.range}.{more}",
                    on_set=partial(self._set_feature, source, feature.name),
                )
            except ConfigurationError as exc:  # another parameter has the name
                logger.info("%s: the feature %s: %s", self._node.full_name, feature.name, exc)
            else:
                self._declared.append(name)
                self._features[name] = feature.name

    async def _set_feature(self, source: FrameSource, name: str, value: bool | float | str) -> None:
        """Set a feature.

        Raises:
            SmartCamError: the device refuses the value.
        """
        await source.features[name].set(value)
        if self._refresh_task is None or self._refresh_task.done():
            self._refresh_task = asyncio.get_running_loop().create_task(
                self._refresh(source), name=f"features of {self._node.full_name}"
            )

    async def _refresh(self, source: FrameSource) -> None:
        """Update all parameters from the device, since setting a feature may change others.

        First waits until the device has applied the setting that caused the call.
        """
        await asyncio.sleep(REFRESH_DELAY)
        for parameter, name in [*self._features.items()]:
            try:
                value = await source.features[name].get()
                is_float = isinstance(self._node.parameters.get(parameter), float)
                self._node.parameters.update(parameter, float(value) if is_float else value)
            except (SmartCamError, ValueError) as exc:
                logger.info("%s: the feature %s: %s", self._node.full_name, name, exc)

    def _declare(self, driver: Any, control: Any) -> None:
        name, is_boolean = control.name, control.kind == "boolean"
        bounds: dict[str, Any] = {}
        if control.kind == "integer":
            bounds = {"minimum": control.least, "maximum": control.most}
            bounds["step"] = control.step if control.step > 1 else None
        try:
            self._node.parameters.declare(
                name,
                bool(control.value) if is_boolean else control.value,
                description=control.range,
                on_set=partial(_set_control, driver, name),
                **bounds,
            )
        except ConfigurationError as exc:  # another parameter has the name, or an odd range
            logger.info("%s: the control %s: %s", self._node.full_name, name, exc)
        else:
            self._declared.append(name)


def _snake_case(name: str) -> str:
    """Return a name in lower case with underscores: ``ExposureTime`` as ``exposure_time``."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()


async def _set_control(driver: Any, name: str, value: int) -> None:
    """Set a control.

    Raises:
        SmartCamError: the device refuses the value, or has another one afterwards.
    """
    actual = await driver.set_control(name, int(value))
    if actual != int(value):
        raise ConfigurationError(f"{name}: set to {int(value)}, the device has {actual}")
