"""Run an agent's outlets, which deliver results of the agent's cameras."""

from __future__ import annotations

import asyncio
import json
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from smartcam._client._inside import Interpretation
from smartcam._extras import from_part
from smartcam._server import Server
from smartcam.backoff import Backoff
from smartcam.exceptions import ConfigurationError, SmartCamError
from smartcam.fleet._file.fleet_file import software_camera
from smartcam.fleet._opening import fleet_camera
from smartcam.models import ApplicationChanged, Connected, Disconnected, Reconnected
from smartcam.observers import Observer
from smartcam.protocols.messages import ResultContainer

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from smartcam.fleet._agent.outlet_service import StoredRequest
    from smartcam.fleet._agent.server import FleetServer
    from smartcam.fleet._program.camera import FleetCamera
    from smartcam.models import CameraEvent, Result
    from smartcam.outlets import Outlets

COMMAND_CONNECT_TIMEOUT = 5.0
"""Seconds of the timeout for connecting to a camera for an outlet's command."""


class FleetOutlets(Server):
    """The outlets of an agent, from ``outlets:`` in a fleet file.

    Start it before the server, and stop it after the server. A slow receiver never delays the
    agent.

    Args:
        server: server of the cameras; not started yet.
        report: callback for an outlet's name and its trouble; "" when the trouble has ended.

    Attributes:
        outlets: the outlets.

    Raises:
        ConfigurationError: the file has no outlets, or wrong ones.
    """

    def __init__(
        self, server: FleetServer, report: Callable[[str, str], None] = lambda _name, _why: None
    ) -> None:
        with from_part("mqtt", '"outlets:" in a fleet file needs'):
            from smartcam.outlets import Outlets
            from smartcam.outlets._inside import StoreQuery, columns_of, do_command
        if server.file.outlets is None:
            raise ConfigurationError(f"fleet {server.file.fleet}: outlets: is not in its file")
        self._server, self._do_command, self._columns_of = server, do_command, columns_of
        self._question_class = StoreQuery
        self.outlets: Outlets = Outlets(
            server.file.outlets,
            server.folder,
            columns=self._columns,
            command=self._command,
            on_trouble=report,
            cameras=self._emulated_cameras,
            application_names=self._names,
        )
        self._observer = _OutletObserver(self)
        self._interpretations: dict[str, tuple[object, Interpretation]] = {}
        self._command_cameras: dict[str, FleetCamera[Any]] = {}
        self._opening_lock = asyncio.Lock()

    async def start(self) -> None:
        """Open the spools and begin to deliver.

        Raises:
            ConfigurationError: a spool cannot be opened, or the server was started.

        Cancellation: the outlets are stopped.
        """
        if self._server.shared_cameras:
            raise ConfigurationError("outlets: start them before the server")
        await self.outlets.start()
        if self._observer not in self._server.observers:
            self._server.observers.append(self._observer)
        self._server.outlet_states = lambda: self.outlets.states
        self._server.stored_results = self.read_stores

    async def stop(self) -> None:
        """Stop; undelivered results stay in the spools, and are delivered after the next start."""
        if self._observer in self._server.observers:
            self._server.observers.remove(self._observer)
        cameras, self._command_cameras = [*self._command_cameras.values()], {}
        for camera in cameras:
            await camera.close()
        await self.outlets.stop()

    async def read_stores(self, request: StoredRequest) -> dict[str, dict[str, Any]]:
        """Return the answers of the stores, by the outlet's name.

        Raises:
            ConfigurationError: one of the stores cannot be read now.

        Cancellation: the thread that reads finishes its work.
        """
        since = None if request.since is None else datetime.fromisoformat(request.since)
        pattern, max_rows = request.camera, request.max_rows
        question = self._question_class(since, request.only_failed, pattern, max_rows)
        answers = await asyncio.to_thread(self.outlets.stored, question)
        return {name: {"rows": answer.rows, **answer.summary} for name, answer in answers.items()}

    def interpretation(self, camera: str) -> Interpretation | None:
        """Return the interpretation of a camera's results; None if the file has no such camera."""
        planned = self._server.reloads.current.plan.get(camera)
        if planned is None:
            return None
        entry = planned.entry
        is_software = entry.software is not None and entry.interpret_as is None
        shared = self._server.shared_cameras.get(camera) if is_software else None
        source: object = entry if shared is None else shared.settings
        known = self._interpretations.get(camera)
        if known is None or known[0] is not source:
            spec: Any = "raw" if entry.interpret_as is None else entry.interpret_as
            if shared is not None:
                spec = shared.settings.interpret_as
            elif is_software:  # spooled results may need it before the camera starts
                device = software_camera(camera, entry.software or {}, self._server.folder)
                spec = {number: program.interpret_as for number, program in device.programs.items()}
            interpretation = Interpretation(spec, lenient=entry.lenient, y_down=entry.y_down)
            known = self._interpretations[camera] = source, interpretation
        return known[1]

    def endian(self, camera: str) -> int:
        """Return the byte order in a camera's last status."""
        shared = self._server.shared_cameras.get(camera)
        return 0 if shared is None else shared.client.endian

    def _emulated_cameras(self) -> dict[str, bool | None]:
        """Return the names of the cameras, and whether each is emulated."""
        plan = self._server.reloads.current.plan
        return {name: planned.entry.emulated is not None for name, planned in plan.items()}

    def _names(self, camera: str) -> Mapping[str, int]:
        shared = self._server.shared_cameras.get(camera)
        if shared is not None:
            return shared.settings.application_names
        planned = self._server.reloads.current.plan.get(camera)
        return {} if planned is None else planned.entry.application_names

    def _columns(self, camera: str, application: int) -> Any:
        interpretation = self.interpretation(camera)
        return self._columns_of(
            None if interpretation is None else interpretation.interpreter(application)
        )

    async def _command(self, name: str, verb: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
        """Carry out a command for an outlet, as a program of the fleet."""
        if name not in self._server.shared_cameras:
            raise ConfigurationError(f"there is no camera {name!r:.120} here")
        async with self._opening_lock:
            camera = self._command_cameras.get(name)
            if camera is None:
                options = {"connect_timeout": COMMAND_CONNECT_TIMEOUT, "reconnect": Backoff()}
                camera = fleet_camera(self._server.address.of(name).url, options, ())
                await camera.open()
                self._command_cameras[name] = camera
        return await self._do_command(camera, verb, arguments)


class _OutletObserver(Observer):
    """Passes the events of an agent's sessions to its outlets."""

    def __init__(self, owner: FleetOutlets) -> None:
        self._owner = owner
        self._states: dict[str, dict[str, Any]] = {}

    def on_state(self, event: CameraEvent) -> None:
        """Pass on connections, losses and applications of a camera."""
        name = event.camera
        state = self._states.setdefault(
            name, {"connected": False, "application": None, "reason": None}
        )
        if isinstance(event, (Connected, Reconnected)):
            state |= {"connected": True, "reason": None}
        elif isinstance(event, Disconnected):
            state |= {"connected": False, "reason": event.reason}
            if not event.expected:
                self._owner.outlets.offer_error(name, event.at, event.reason, "Disconnected")
        elif isinstance(event, ApplicationChanged):
            state |= {"application": event.application}
        else:
            return
        self._owner.outlets.state_changed(name, {**state, "at": event.at})

    def on_results(self, results: Sequence[Result]) -> None:
        """Pass on results that came together."""
        camera = results[0].camera
        interpretation, endian = self._owner.interpretation(camera), self._owner.endian(camera)
        for result in results:
            self._offer(result, interpretation, endian)

    def _offer(self, result: Result, interpretation: Interpretation | None, endian: int) -> None:
        cells_json = result.value.cells

        def read_value() -> tuple[Any, int | None]:
            if interpretation is None:
                return None, None
            content: dict[str, Any] = json.loads(cells_json) if cells_json else {}
            texts = content.get("cells")
            container = ResultContainer(
                application=result.application,
                data=result.raw,
                cells=None if texts is None else tuple(texts),
                fault=content.get("fault"),
            )
            at = result.received_at
            camera, number = result.camera, result.number
            value, sequence, _ = interpretation(
                container, endian, camera=camera, number=number, at=at
            )
            return value, sequence

        self._owner.outlets.offer_result(result, read_value)

    def on_error(self, camera: str, error: SmartCamError, triggered_at: datetime | None) -> None:
        """Pass on the error of a trigger without a result."""
        if triggered_at is not None:
            at, kind = datetime.now(UTC), type(error).__name__
            self._owner.outlets.offer_error(camera, at, str(error), kind, triggered_at)
