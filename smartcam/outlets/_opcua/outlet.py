"""The outlet: a server of OPC UA, and what it is given."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

from smartcam._extras import load
from smartcam.outlets._entry import OutletError
from smartcam.outlets._opcua.settings import OpcUaSettings
from smartcam.outlets._outlet import Outlet

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from smartcam.outlets._entry import OutletEntry
    from smartcam.outlets._opcua.server import VisionServer
    from smartcam.outlets._outlet import OutletDesk

MAX_STATES = 1_000
"""Cameras of one server."""


class OpcUaOutlet(Outlet[OpcUaSettings]):
    """Serves cameras as vision systems; each result is delivered when the server has it."""

    settings_class = OpcUaSettings
    max_batch: ClassVar[int] = 100

    def __init__(self, name: str, settings: OpcUaSettings, folder: Path, desk: OutletDesk) -> None:
        super().__init__(name, settings, folder, desk)
        self._server: VisionServer | None = None
        self._states: dict[str, Mapping[str, Any]] = {}

    async def open(self) -> None:
        """Listen.

        Raises:
            MissingExtraError: asyncua is not installed.
            ConfigurationError: a secret, a certificate or a key is not there.
            OSError: the port is taken.
        """
        load("asyncua")
        from smartcam.outlets._opcua.server import VisionServer

        server = VisionServer(self.name, self.settings, self.folder, self.desk)
        try:
            await server.start()
        except BaseException:
            await server.stop()
            raise
        self._server = server
        for camera, state in self._states.items():
            server.state_changed(camera, state)

    async def deliver(self, entries: Sequence[OutletEntry]) -> None:
        """Have entries published."""
        if self._server is None:
            raise OutletError("the server does not listen")
        await self._server.publish(entries)

    def state_changed(self, camera: str, state: Mapping[str, Any]) -> None:
        """Have the camera's state published soon."""
        if camera in self._states or len(self._states) < MAX_STATES:
            self._states[camera] = state
            if self._server is not None:
                self._server.state_changed(camera, state)

    async def watch(self) -> None:
        """Wait until the server fails."""
        if self._server is not None:
            await self._server.failed()

    async def close(self) -> None:
        """Stop listening."""
        server, self._server = self._server, None
        if server is not None:
            await server.stop()
