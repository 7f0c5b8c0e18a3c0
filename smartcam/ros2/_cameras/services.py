"""The services of a camera's node: eleven of the thesis with which smartcam began, and others.

A call that fails gets a reply with the error, since all these replies have a field for it.
"""

from __future__ import annotations

import asyncio
import functools
import logging
from typing import TYPE_CHECKING, Any, Final

from smartcam._client._inside import has_pixel_positions
from smartcam._json import object_json
from smartcam._thesis import MAX_TIMEOUT, THESIS, spec_of_text
from smartcam._thesis_calibration import CALIBRATION
from smartcam.camera import DEFAULT_TRIGGER_TIMEOUT
from smartcam.exceptions import ConfigurationError, SmartCamError
from smartcam.interpreters import resolve
from smartcam.ros2._cameras.calibrations import CalibrationServices
from smartcam.ros2._cameras.messages import error_text
from smartcam.ros2._cameras.reading import is_calibrated, localizations_in_metres
from smartcam.ros2._cameras.thesis import RosThesisCamera, ThesisServices

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.calibration._inside import ThesisCalibration
    from smartcam.camera import Camera
    from smartcam.ros2._cameras.results import CameraResults
    from smartcam.ros2._cameras.thesis import ThesisLifecycle

logger: logging.Logger = logging.getLogger("smartcam.ros2")

MAX_RESULTS: Final = 1000
"""Largest number of results in one answer."""

MAX_INPUT_BYTES: Final = 1 << 16
MAX_LAYOUT_CHARACTERS: Final = 10_000
CLOSE_TIMEOUT: Final = 5.0


class CameraServices:
    """Serves a camera to other nodes, whose calls are handled like any program's.

    Simultaneous calls are handled like calls of two programs: one trigger after the other, each
    within its own timeout. A call ends when its caller is lost, and the camera stays usable.

    Args:
        camera: the camera.
        node: the camera's node.
        results: the results that the node publishes.
        lifecycle: the node's life cycle.
        calibrations: the camera's calibrations; None if there is no folder for them.
    """

    def __init__(
        self,
        camera: Camera[Any],
        node: Any,
        results: CameraResults,
        lifecycle: ThesisLifecycle,
        calibrations: ThesisCalibration | None = None,
    ) -> None:
        self._camera, self._node, self._results = camera, node, results
        node_side = RosThesisCamera(camera, node, results, lifecycle)
        self._thesis = ThesisServices(node_side, node, results)
        self._calibration = CalibrationServices(camera, calibrations)
        self._std_services: dict[str, tuple[str, Callable[[Any], Awaitable[str]]]] = {
            "trigger": ("Trigger", self._trigger),
            "start": ("Trigger", self._start),
            "stop": ("Trigger", self._stop),
            "reset_errors": ("Trigger", self._reset_errors),
            "reboot": ("Trigger", self._reboot),
            "run": ("SetBool", self._run),
        }
        # a trigger of another application needs more time, to switch twice
        self._call_timeout = MAX_TIMEOUT + 2 * camera.settings.switch_timeout + CLOSE_TIMEOUT
        self._services: list[Any] = []

    def start(self) -> None:
        """Serve. Idempotent.

        Raises:
            RosError: the node is not open.
        """
        if self._services:
            return
        try:
            answers = dict.fromkeys(THESIS, self._thesis.answer)
            answers |= dict.fromkeys(CALIBRATION, self._calibration.answer)
            for name, answer in answers.items():
                call = functools.partial(answer, name)
                self._serve(name, f"smartcam_msgs/srv/{name}", self._with_error_field(call))
            for name, (type_name, answer_text) in self._std_services.items():
                self._serve(
                    name, f"std_srvs/srv/{type_name}", self._with_success_field(answer_text)
                )
            trigger_results = self._with_error_field(self._trigger_results)
            self._serve("trigger_results", "smartcam_msgs/srv/TriggerResults", trigger_results)
        except BaseException:
            self._withdraw()
            raise

    async def close(self) -> None:
        """Withdraw the services and cancel running calls. Idempotent, bounded."""
        services = self._withdraw()
        await self._thesis.close()
        try:
            async with asyncio.timeout(CLOSE_TIMEOUT):
                for service in services:
                    if hasattr(service, "wait_closed"):
                        await service.wait_closed()
        except TimeoutError:
            logger.warning("%s ! a call does not end", self._node.full_name)

    def _withdraw(self) -> list[Any]:
        services, self._services = self._services, []
        for service in services:
            service.close()
        return services

    # ------------------------------------------------------------------ errors as fields

    def _serve(self, name: str, type_name: str, handler: Any) -> None:
        response = self._node.types.service(type_name).response

        async def answer(request: Any) -> Any:
            return response.new(**await handler(request))

        self._services.append(
            self._node.serve(f"~/{name}", type_name, answer, timeout=self._call_timeout)
        )

    def _with_error_field(
        self, call: Callable[[Any], Awaitable[dict[str, Any]]]
    ) -> Callable[[Any], Awaitable[dict[str, Any]]]:
        """Return a handler that answers with the fields of ``call``, or with ``error``."""

        async def handler(request: Any) -> dict[str, Any]:
            try:
                return {"error": "", **await call(request)}
            except Exception as exc:  # noqa: BLE001 - the caller gets any error
                return {"error": self._error_text(exc)}

        return handler

    def _with_success_field(
        self, call: Callable[[Any], Awaitable[str]]
    ) -> Callable[[Any], Awaitable[dict[str, Any]]]:
        """Return a handler that answers with ``success`` and the text of ``call``, or the error."""

        async def handler(request: Any) -> dict[str, Any]:
            try:
                return {"success": True, "message": await call(request)}
            except Exception as exc:  # noqa: BLE001 - the caller gets any error
                return {"success": False, "message": self._error_text(exc)}

        return handler

    def _error_text(self, error: Exception) -> str:
        if not isinstance(error, SmartCamError):
            logger.error("%s ! a service failed", self._node.full_name, exc_info=error)
            return error_text(RuntimeError(f"{type(error).__name__}: {error}"))
        return error_text(error)

    # ------------------------------------------------------------------ std_srvs

    async def _trigger(self, _: object) -> str:
        return object_json((await self._camera.trigger())._asdict())

    async def _start(self, _: object) -> str:
        await self._camera.start()
        return ""

    async def _stop(self, _: object) -> str:
        await self._camera.stop()
        return ""

    async def _run(self, request: Any) -> str:
        return await (self._start if request.data else self._stop)(request)

    async def _reset_errors(self, _: object) -> str:
        return str(await self._camera.reset_errors())

    async def _reboot(self, _: object) -> str:
        await self._camera.reboot()
        return ""

    # ------------------------------------------------------------------ typed

    async def _trigger_results(self, request: Any) -> dict[str, Any]:
        camera = self._camera
        result_count, spec = request.results_per_trigger or 1, spec_of_text(request.interpret_as)
        self._check(request, result_count, spec)
        results = await camera.trigger(
            request.application_id or None,
            interpret_as=spec,
            input=bytes(request.input) or None,
            timeout=request.timeout or DEFAULT_TRIGGER_TIMEOUT,
            when_busy="refuse" if request.refuse_when_busy else "wait",
            results_per_trigger=result_count,
        )
        make = self._results.messages.result
        messages = [
            make(result, localizations_in_metres(camera, result, spec)) for result in results
        ]
        return {"results": messages}

    def _check(self, request: Any, result_count: int, spec: str | None) -> None:
        name = self._camera.name
        if not 0 <= request.timeout <= MAX_TIMEOUT:
            raise ConfigurationError(
                f"{name}: timeout {request.timeout}: expected seconds up to {MAX_TIMEOUT:g}, or 0 "
                f"for {DEFAULT_TRIGGER_TIMEOUT:g}"
            )
        for quantity, got, most in (
            ("results_per_trigger", result_count, MAX_RESULTS),
            ("bytes of input", len(request.input), MAX_INPUT_BYTES),
            ("characters of interpret_as", len(spec or ""), MAX_LAYOUT_CHARACTERS),
        ):
            if got > most:
                raise ConfigurationError(f"{name}: {quantity}: expected {most} at most, got {got}")
        if spec is not None and has_pixel_positions(resolve(spec)):
            application = request.application_id or self._camera.active_application or 0
            if not is_calibrated(self._camera, application):
                raise ConfigurationError(
                    f"{name}: interpret_as {spec!r:.80}: expected lengths, since poses in ROS are "
                    "in metres, got pixels"
                )
