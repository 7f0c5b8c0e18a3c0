"""Several emulated cameras that are started and stopped together."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from smartcam._arguments import check_iterable, check_kind
from smartcam._server import Server
from smartcam.emulator._makes import emulated_class
from smartcam.emulator._scenario.file import load_scenarios
from smartcam.emulator._scenario.scenario import Scenario
from smartcam.exceptions import ConfigurationError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from smartcam.emulator._clock import Clock
    from smartcam.emulator._wire_camera import WireCamera


class EmulatedFleet(Server):
    """Emulated cameras by name; an asynchronous context manager.

    ::

        async with EmulatedFleet("cell.yaml") as fleet:
            fleet["left"].url

    Args:
        scenarios: the path of a scenario file, or scenarios with different names.
        host: address to listen on; without a port.
        transport: ``"tcp"`` or ``"udp"``; by default the scenario's.
        dialect: name of the wire dialect; by default the scenario's.
        quirks: fields of :class:`~smartcam.emulator.Quirks` that override those of each scenario.
        clock: clock of all cameras; by default real time.

    Raises:
        ConfigurationError: an argument is wrong.
        MissingExtraError: a file was given and PyYAML is not installed.
    """

    def __init__(
        self,
        scenarios: Iterable[Scenario] | str | Path,
        *,
        host: str = "127.0.0.1",
        transport: Literal["tcp", "udp"] | None = None,
        dialect: str | None = None,
        quirks: dict[str, Any] | None = None,
        clock: Clock | None = None,
    ) -> None:
        given = (
            load_scenarios(scenarios, dialect=dialect)
            if isinstance(scenarios, (str, Path))
            else check_iterable(scenarios, "scenarios", "a file's path, or scenarios", "emulator")
        )
        self._cameras: dict[str, WireCamera] = {}
        for scenario in given:
            check_kind(scenario, Scenario, "scenarios", "a file's path, or scenarios", "emulator")
            if scenario.name in self._cameras:
                raise ConfigurationError(f"emulator: two cameras are called {scenario.name!r}")
            self._cameras[scenario.name] = emulated_class(scenario.protocol).from_scenario(
                scenario,
                host=host,
                transport=transport,
                dialect=dialect,
                quirks=quirks,
                clock=clock,
            )
        self._stack = contextlib.AsyncExitStack()

    def __getitem__(self, name: str) -> WireCamera:
        """Return a camera.

        Raises:
            ConfigurationError: no camera has this name.
        """
        try:
            return self._cameras[name]
        except KeyError as exc:
            names = ", ".join(self._cameras)
            raise ConfigurationError(
                f"the fleet has no camera {name!r}; there are {names}"
            ) from exc

    def __iter__(self) -> Iterator[WireCamera]:
        return iter(self._cameras.values())

    def __len__(self) -> int:
        return len(self._cameras)

    @property
    def cameras(self) -> dict[str, WireCamera]:
        """All cameras by name, in order; a new mapping each time."""
        return dict(self._cameras)

    @property
    def urls(self) -> dict[str, str]:
        """The cameras' addresses by name."""
        return {name: camera.url for name, camera in self._cameras.items()}

    async def start(self) -> None:
        """Start all cameras; do nothing if they are started already.

        Raises:
            ConfigurationError: one of the cameras cannot listen; none is started.

        Cancellation: leaves all stopped.
        """
        async with contextlib.AsyncExitStack() as stack:
            for camera in self._cameras.values():
                await stack.enter_async_context(camera)
            self._stack = stack.pop_all()

    async def stop(self) -> None:
        """Stop all cameras. Harmless when called twice."""
        await self._stack.aclose()
