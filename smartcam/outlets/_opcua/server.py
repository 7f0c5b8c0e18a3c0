"""Run the OPC UA server, which presents each camera to clients as a vision system."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import itertools
import logging
import secrets
from typing import TYPE_CHECKING, Any

from asyncua import Server, ua

from smartcam._user_code import text_of
from smartcam.exceptions import ConfigurationError, SmartCamError
from smartcam.outlets._opcua.book import ResultBook
from smartcam.outlets._opcua.events import Events
from smartcam.outlets._opcua.files import TransferFiles
from smartcam.outlets._opcua.methods import Method, Methods, type_number
from smartcam.outlets._opcua.nodes import CameraNodes
from smartcam.outlets._opcua.nodeset import AUTOMATIC, URI, VISION, node_ids, nodeset_text
from smartcam.outlets._opcua.publishing import PublishQueue
from smartcam.outlets._opcua.security import GuardedServer, Users, configure_security
from smartcam.outlets._opcua.system import VisionSystem
from smartcam.outlets._opcua.values import VisionValues
from smartcam.outlets._records import picture_of

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping, Sequence
    from pathlib import Path

    from smartcam.outlets._entry import OutletEntry
    from smartcam.outlets._opcua.jobs import VisionJob, VisionResult
    from smartcam.outlets._opcua.nodeset import Transition
    from smartcam.outlets._opcua.settings import OpcUaSettings
    from smartcam.outlets._outlet import Column, OutletContext

logger: logging.Logger = logging.getLogger("smartcam.outlets")

MAX_CAMERAS = 1_000
"""Largest number of cameras of one server."""

MAX_CONNECTIONS = 100
"""Largest number of clients that are connected to a server at the same time."""

METHOD_TYPES = (VISION, AUTOMATIC, "RecipeManagementType", "ResultManagementType")
"""Types of the nodeset whose methods a camera has."""

OWN_URI = "urn:smartcam:outlets:opcua"
"""Namespace of the nodes of cameras, and of the structures for their layouts."""


class VisionServer:
    """A server of OPC UA with a vision system for each camera.

    Args:
        name: name of the outlet.
        settings: settings of the server.
        folder: folder of relative paths.
        context: functions of the process that has the cameras.
    """

    def __init__(
        self, name: str, settings: OpcUaSettings, folder: Path, context: OutletContext
    ) -> None:
        self.name, self.settings, self.folder, self.context = name, settings, folder, context
        self.publish_queue = PublishQueue()
        self.book = ResultBook(settings.kept_results)
        self.cameras: dict[str, CameraView] = {}
        self._states: dict[str, Mapping[str, Any]] = {}
        self._making_tasks: dict[str, asyncio.Task[None]] = {}
        self.calls: dict[tuple[ua.NodeId, str], Callable[..., Awaitable[Any]]] = {}
        self._run_id, self._jobs = secrets.token_hex(4), itertools.count(1)
        self.server: Any = None
        self.files: TransferFiles | None = None

    async def start(self) -> None:
        """Open the port, and load the nodeset.

        Raises:
            ConfigurationError: a secret, a certificate or a key does not exist.
            OSError: the port is in use.
        """
        users = Users(self.settings, self.folder)
        self.server = server = Server(iserver=GuardedServer(users))
        await server.init()
        server.set_server_name(f"smartcam {self.name}")
        server.product_uri = "urn:smartcam"
        server.set_endpoint(self.settings.listen)
        server.iserver.max_connections = MAX_CONNECTIONS
        await configure_security(server, self.name, self.settings, self.folder)
        await server.import_xml(xmlstring=nodeset_text())
        vision = await server.get_namespace_index(URI)
        own_index = await server.register_namespace(OWN_URI)
        self.spaces = vision, own_index
        self.values = VisionValues(server, vision, own_index)
        self.events = Events(server, vision)
        self.files = TransferFiles(server, own_index)
        await self._link_types()
        self.publish_queue.start()
        names = filter(self.settings.chooses, self.context.cameras().keys())
        for name in itertools.islice(names, MAX_CAMERAS):
            await self._make_camera(name)
        await server.start()

    async def _link_types(self) -> None:
        """Run a camera's method also if a client calls it by the node of the object type."""
        for kind in METHOD_TYPES:
            type_node = self.server.get_node(ua.NodeId(node_ids()[kind], self.spaces[0]))
            for method in await type_node.get_methods():
                name = (await method.read_browse_name()).Name
                self.server.link_method(method, functools.partial(self._call, name))

    async def _call(self, name: str, parent: ua.NodeId, *arguments: ua.Variant) -> Any:
        call = self.calls.get((parent, name))
        if call is None:
            return ua.StatusCode(ua.StatusCodes.BadMethodInvalid)
        return await call(parent, *arguments)

    async def stop(self) -> None:
        """End jobs, and stop listening; the port is free afterwards even if something fails."""
        for task in [*self._making_tasks.values()]:
            task.cancel()
        server, self.server = self.server, None
        async with contextlib.AsyncExitStack() as stack:
            if server is not None:
                stack.push_async_callback(server.stop)
            if self.files is not None:
                stack.callback(self.files.close)
            stack.push_async_callback(self.publish_queue.stop)
            for camera in self.cameras.values():
                stack.push_async_callback(camera.system.close)

    async def wait_failed(self) -> None:
        """Wait until publishing has failed for good, and raise the reason."""
        await self.publish_queue.wait_failed()

    def new_job_id(self) -> str:
        """Return a new id for a job; ids are unique, also across restarts."""
        return f"{self._run_id}-{next(self._jobs)}"

    # ------------------------------------------------------------------ from cameras

    def state_changed(self, camera: str, state: Mapping[str, Any]) -> None:
        """Pass on a camera's state; first make the nodes of a new camera."""
        view = self.cameras.get(camera)
        if view is not None:
            view.system.camera_changed(state)
            return
        self._states[camera] = state
        if camera not in self._making_tasks and len(self.cameras) < MAX_CAMERAS:
            task = asyncio.get_running_loop().create_task(self._make_camera(camera))
            self._making_tasks[camera] = task
            task.add_done_callback(lambda done: self._on_made(camera, done))

    def _on_made(self, camera: str, done: asyncio.Task[None]) -> None:
        self._making_tasks.pop(camera, None)
        if not done.cancelled() and (error := done.exception()) is not None:
            logger.error("outlet %s: camera %s: %s", self.name, camera, text_of(error))

    async def publish(self, entries: Sequence[OutletEntry]) -> None:
        """Publish entries, and return when clients can see them."""
        for entry in entries:
            if entry.camera and entry.camera not in self.cameras:
                await self._make_camera(entry.camera)
            views = [self.cameras[entry.camera]] if entry.camera else [*self.cameras.values()]
            for view in views:  # several views: a gap may concern all cameras
                view.system.accept_entry(entry)
        await self.publish_queue.wait_published()

    async def _make_camera(self, name: str) -> None:
        """Make the nodes of a camera, unless there are nodes already."""
        making = self._making_tasks.get(name)
        if making is not None and making is not asyncio.current_task():
            await asyncio.shield(making)
        if name in self.cameras:
            return
        if len(self.cameras) >= MAX_CAMERAS:
            raise ConfigurationError(f"expected {MAX_CAMERAS} cameras at most")
        view = CameraView(self, name)
        await view.make_nodes()
        self.cameras[name] = view
        state = self._states.pop(name, None)
        if state is not None:
            view.system.camera_changed(state)


class CameraView:
    """Connects a camera's states and jobs with the nodes that show them.

    Args:
        server: server of the camera.
        name: name of the camera.
    """

    def __init__(self, server: VisionServer, name: str) -> None:
        self._server, self._settings = server, server.settings
        parts = server.events, server.values, server.publish_queue
        self.nodes = CameraNodes(server.server, server.spaces, name, parts)
        self.system = VisionSystem(
            name,
            server.settings,
            self._command,
            self,
            picture=self._picture,
            get_names=lambda: server.context.application_names(name),
            make_job_id=server.new_job_id,
            simulated=dict(server.context.cameras()).get(name),
        )
        self._methods = Methods(
            self.system, self.nodes, server.values, server.book, server.publish_queue.wait_published
        )

    async def make_nodes(self) -> None:
        """Make the nodes, and link the methods."""
        await self.nodes.make_nodes(self.system.states)
        for path, method in self._methods.table().items():
            await self._link_method(path, method)
        if self._server.files is not None:
            await self._server.files.link(self.nodes, self._server.book)

    async def _link_method(self, path: str, method: Method) -> None:
        node = self._server.server.get_node(self.nodes.id(path))
        types: list[int] = []
        with contextlib.suppress(ua.UaStatusCodeError):  # a method without arguments
            inputs = await (await node.get_child("0:InputArguments")).read_value()
            types = [type_number(argument.DataType, argument.ValueRank) for argument in inputs]

        async def call(_parent: ua.NodeId, *arguments: ua.Variant) -> Any:
            return await self._methods.call(method, types, arguments)

        self._server.server.link_method(node, call)
        parent, _, name = path.rpartition(".")
        self._server.calls[self.nodes.id(parent), name] = call

    async def _command(self, name: str, verb: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
        if self._server.context.command is None:
            raise ConfigurationError("commands are not allowed here")
        return await self._server.context.command(name, verb, arguments)

    def _picture(self, fields: Mapping[str, Any]) -> Path | None:
        pattern = self._settings.pictures
        return None if pattern is None else picture_of(pattern, self._server.folder, fields)

    # ------------------------------------------------------------------ to clients

    def show_transition(self, transition: Transition, job: VisionJob | None, reason: str) -> None:
        """Show a transition, and raise its events."""
        application = self.system.prepared_application or 0
        self.nodes.prepared = self.system.recipe_name(application), application
        self.nodes.show_transition(transition, job, reason)

    def show_acquisition(self, job: VisionJob) -> None:
        """Raise the event that a job's picture is taken, after which the part may move."""
        self.nodes.show_acquisition(job)

    def show_result(self, result: VisionResult) -> None:
        """Show a result, and raise its event."""
        recipe = self.system.recipe_name(result.application)
        self.nodes.show_result(result, recipe, self._columns(result), self._server.book.add)

    def _columns(self, result: VisionResult) -> Sequence[Column]:
        """Return the columns of a result's layout; empty if the layout is not known."""
        if result.application is None:
            return ()
        try:
            return self._server.context.columns(result.camera, result.application)
        except SmartCamError as exc:
            self.show_message(f"application {result.application}: {exc}", type(exc).__name__, None)
            return ()

    def show_message(self, text: str, kind: str, job: VisionJob | None) -> None:
        """Raise an event with a text."""
        self.nodes.show_message(text, kind, job)

    def show_trouble(self, reason: str) -> None:
        """Show the reason why the camera cannot be used; "" if it can be used."""
        self.nodes.show_trouble(reason)
