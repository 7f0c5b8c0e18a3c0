"""Run a gateway: listen on a port, and serve the robots that connect."""

from __future__ import annotations

import dataclasses
import logging
from typing import TYPE_CHECKING

from smartcam._accepting import Acceptor, Places, listening_socket
from smartcam._server import Server
from smartcam.exceptions import ConfigurationError
from smartcam.gateway._counts import GatewayCounts
from smartcam.gateway._lines import AnswerWriter
from smartcam.gateway._link import RobotLink
from smartcam.gateway._parts import Converter
from smartcam.gateway._requests import GatewayCamera
from smartcam.gateway._settings import GatewaySettings

if TYPE_CHECKING:
    import socket

    from smartcam.camera import Camera

_log = logging.getLogger("smartcam.gateway")


class Gateway(Server):
    """Answers controllers that ask where the parts in a camera's picture are.

    ::

        async with smartcam.connect(url, interpret_as="localizations") as camera:
            async with Gateway(camera, GatewaySettings(robot="ur")) as gateway:
                print(gateway.address)

    There is no password: any program that can connect to the port may trigger the camera.

    Args:
        camera: the camera; the caller opens and closes it. While it has no session, requests are
            answered with the reason.
        settings: address to listen on, and form of the answers.

    Raises:
        ConfigurationError: ``interpret_as`` of the camera is not valid.
    """

    def __init__(self, camera: Camera, settings: GatewaySettings | None = None) -> None:
        self.settings: GatewaySettings = settings or GatewaySettings()
        parts = Converter(self.settings, camera.settings.interpret_as)
        self._counts = GatewayCounts()
        self._shared = GatewayCamera(camera, self.settings, parts, self._counts)
        self._writer = AnswerWriter(self.settings.style, parts.names)
        places: Places[RobotLink] = Places(
            self.settings.clients,
            timeout=self.settings.idle,
            missing="no request",
            session_name="a robot",
        )
        self._acceptor: Acceptor[RobotLink] = Acceptor(
            self._make_link, places, _log, name="smartcam.gateway"
        )
        self._socket: socket.socket | None = None
        self._port = self.settings.host_and_port[1]

    def _make_link(self) -> RobotLink:
        return RobotLink(self._shared, self._writer, self._acceptor)

    @property
    def address(self) -> str:
        """Address to which robots connect, tcp/HOST:PORT."""
        host = self.settings.host_and_port[0]
        return f"tcp/{f'[{host}]' if ':' in host else host}:{self._port}"

    @property
    def counts(self) -> GatewayCounts:
        """Counts of the requests and answers so far."""
        return dataclasses.replace(self._counts)

    @property
    def camera(self) -> Camera:
        """The camera. The caller may set another object, after this one could not be opened."""
        return self._shared.camera

    @camera.setter
    def camera(self, camera: Camera) -> None:
        self._shared.camera = camera

    async def start(self) -> None:
        """Open the port; do nothing if it is already open.

        Raises:
            ConfigurationError: the gateway cannot listen on the address in the settings.

        Cancellation: leaves the port closed.
        """
        if self._socket is not None:
            return
        host, port = self.settings.host_and_port
        try:
            self._socket = await listening_socket(host, port)
        except (OSError, ValueError, OverflowError) as exc:
            raise ConfigurationError(
                f"gateway: cannot listen on {host} port {port}: {exc}"
            ) from exc
        self._port = self._socket.getsockname()[1]
        self._acceptor.open(self._socket)

    async def stop(self) -> None:
        """Close the port and all connections; unfinished requests get no answer."""
        listener, self._socket = self._socket, None
        if listener is None:
            return
        self._acceptor.close()
        listener.close()
        await self._acceptor.wait_closed()
        for link in self._acceptor.places:
            await link.finish()
