"""Define the outlet that runs an OPC UA server in a thread of its own."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, ClassVar

from smartcam._extras import load
from smartcam._loop_thread import LoopThread
from smartcam.exceptions import ConfigurationError, OutletError
from smartcam.outlets._opcua.settings import OpcUaSettings
from smartcam.outlets._outlet import Outlet, OutletContext

if TYPE_CHECKING:
    from collections.abc import Coroutine, Mapping, Sequence
    from pathlib import Path

    from smartcam.outlets._entry import OutletEntry
    from smartcam.outlets._opcua.server import VisionServer

MAX_STATES = 1_000
"""Largest number of cameras whose state is kept."""


class OpcUaOutlet(Outlet[OpcUaSettings]):
    """Serves cameras as vision systems; a result counts as delivered when the server has it.

    The server runs in its own thread, so that loading the nodeset and serving clients do not delay
    the cameras' event loop.
    """

    settings_class = OpcUaSettings
    max_batch: ClassVar[int] = 100

    def __init__(
        self, name: str, settings: OpcUaSettings, folder: Path, context: OutletContext
    ) -> None:
        super().__init__(name, settings, folder, context)
        self._thread = LoopThread(f"smartcam.outlets.{name}.server")
        self._loop: asyncio.AbstractEventLoop | None = None  # event loop of the cameras
        self._server: VisionServer | None = None
        self._states: dict[str, Mapping[str, Any]] = {}
        self._open = False

    async def open(self) -> None:
        """Start the server's thread, and listen.

        Raises:
            MissingExtraError: asyncua is not installed.
            ConfigurationError: a secret, a certificate or a key does not exist.
            OSError: the port is in use.
        """
        load("asyncua")
        from smartcam.outlets._opcua.server import VisionServer

        self._loop = asyncio.get_running_loop()
        context = OutletContext(
            self.context.columns,
            self._command,
            self.context.cameras,
            self.context.application_names,
        )
        await asyncio.to_thread(self._thread.start)
        self._server = server = VisionServer(self.name, self.settings, self.folder, context)
        await self._in_server_thread(server.start())
        self._open = True
        for camera, state in self._states.items():
            self._show_state(server, camera, state)

    async def deliver(self, entries: Sequence[OutletEntry]) -> None:
        """Publish entries in the server's thread."""
        if self._server is None:
            raise OutletError("the server does not listen")
        await self._in_server_thread(self._server.publish(entries))

    def state_changed(self, camera: str, state: Mapping[str, Any]) -> None:
        """Schedule the camera's state to be published."""
        if camera in self._states or len(self._states) < MAX_STATES:
            self._states[camera] = state
            if self._open and self._server is not None:
                self._show_state(self._server, camera, state)

    async def watch(self) -> None:
        """Wait until the server fails."""
        if self._server is not None:
            await self._in_server_thread(self._server.wait_failed())

    async def close(self) -> None:
        """Stop listening."""
        server, self._server, self._open = self._server, None, False
        try:
            if server is not None:
                await self._in_server_thread(server.stop())
        finally:
            await asyncio.to_thread(self._thread.stop)

    def _show_state(self, server: VisionServer, camera: str, state: Mapping[str, Any]) -> None:
        self._thread.post(lambda: server.state_changed(camera, state))

    async def _in_server_thread(self, work: Coroutine[Any, Any, None]) -> None:
        """Run a coroutine in the server's thread."""
        await asyncio.wrap_future(self._thread.submit(work))

    async def _command(
        self, camera: str, verb: str, arguments: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Carry out a command in the cameras' thread; called in the server's thread."""
        if self.context.command is None or self._loop is None:
            raise ConfigurationError("commands are not allowed here")
        work: Any = self.context.command(camera, verb, arguments)
        outcome: dict[str, Any] = await asyncio.wrap_future(
            asyncio.run_coroutine_threadsafe(work, self._loop)
        )
        return outcome
