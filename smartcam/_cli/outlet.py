"""``smartcam outlet``: deliver a camera's results to brokers and databases."""

from __future__ import annotations

import asyncio
import contextlib
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from smartcam._cli.options import CAMERA, CONNECTS, Options, runs
from smartcam.backoff import Backoff
from smartcam.exceptions import SmartCamError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.camera import Camera
    from smartcam.models import CameraEvent
    from smartcam.outlets import Outlets


@click.command(
    help="Bring a camera's results to brokers and databases, as a YAML file says, until Ctrl-C. "
    "Undelivered results wait in a spool beside the file, also for the next start. The file "
    "has the section outlets: of a fleet file. Prints a line for each trouble, "
    f"and the accounts at the end. {CONNECTS}"
)
@click.argument("url")
@click.argument("file", metavar="FILE.yaml")
@runs(
    *("--application", "--interpret-as", "--y-down", "--calibration", "--name", "--seconds"),
    *CAMERA,
    interrupted=0,
    terminated=0,
)
async def outlet(url: str, file: str, options: Options) -> None:
    """Deliver results."""
    from smartcam._cli.live import have_open
    from smartcam.outlets import Outlets
    from smartcam.outlets._inside import OutletsFile

    outlets_file = OutletsFile.load(file)
    source = _OutletSource(options)
    outlets = Outlets(
        outlets_file.outlets,
        Path(file).parent,
        columns=source.columns,
        command=source.command,
        on_trouble=source.tell,
        cameras=source.cameras,
        names=source.names,
    )
    url = await options.located(url)
    with options.cameras(url, reconnect=Backoff()) as make:
        async with outlets:
            try:
                with contextlib.suppress(TimeoutError):  # --seconds are over
                    async with asyncio.timeout(options.seconds):
                        camera = make()
                        await source.follow(camera, "", outlets)
                        follow = source.follower(outlets)
                        await have_open(camera, make, follow, source.opened)
            finally:
                await source.stop()
        for name, state in outlets.states.items():
            options.show({"outlet": name, **state.account.fields()}, f"{name}: {state.account}")


class _OutletSource:
    """The source of the outlets: a camera's results, errors and states."""

    def __init__(self, options: Options) -> None:
        self._options = options
        self.camera: Camera[Any] | None = None
        self._tasks: list[asyncio.Task[None]] = []

    def follower(self, outlets: Outlets) -> Any:
        async def follow(camera: Camera[Any], why: str) -> None:
            await self.follow(camera, why, outlets)

        return follow

    async def follow(self, camera: Camera[Any], why: str, outlets: Outlets) -> None:
        """Take results and events of this camera from now on."""
        await self.stop()
        self.camera = camera
        if why:
            click.echo(f"note: {why}; it is tried on", err=True)
        loop = asyncio.get_running_loop()
        results, events = camera.results(max_queue=100_000), camera.events()
        self._tasks = [
            loop.create_task(_results(camera.name, results, outlets)),
            loop.create_task(_events(events, outlets)),
        ]

    def opened(self) -> None:
        if self.camera is not None:
            self._options.show({"camera": self.camera.url}, f"camera: {self.camera.url}")

    async def stop(self) -> None:
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)

    def names(self, _camera: str) -> Mapping[str, int]:
        return {} if self.camera is None else self.camera.settings.application_names

    def columns(self, _camera: str, application: int) -> Any:
        from smartcam._client._inside import Interpretation
        from smartcam.outlets._inside import columns_of

        options = self._options
        spec = options.interpret_as or "raw"
        if self.camera is not None:  # a camera with layouts of its own has them here
            spec = self.camera.settings.interpret_as
        read = Interpretation(spec, lenient=False, y_down=options.y_down)
        return columns_of(read.interpreter(application))

    async def command(self, name: str, verb: str, given: Mapping[str, Any]) -> dict[str, Any]:
        from smartcam.exceptions import ConfigurationError
        from smartcam.outlets._inside import do_command

        if self.camera is None or name != self.camera.name:
            raise ConfigurationError(f"there is no camera {name!r:.120} here")
        return await do_command(self.camera, verb, given)

    def cameras(self) -> dict[str, bool | None]:
        return {} if self.camera is None else {self.camera.name: None}

    def tell(self, name: str, why: str) -> None:
        text = why or "delivers again"
        click.echo(f"{datetime.now(UTC).astimezone():%H:%M:%S} outlet {name}: {text}", err=True)


async def _results(name: str, results: Any, outlets: Outlets) -> None:
    """Pass on results; results that the subscription lost are reported as an error."""
    reported = 0
    while True:
        try:
            result = await anext(results)
        except StopAsyncIteration:
            return
        except SmartCamError as exc:
            outlets.offer_error(name, datetime.now(UTC), str(exc), type(exc).__name__)
            if results.ended:
                return
        else:
            outlets.offer_result(result)
        account = results.statistics()
        lost = account.dropped + account.missed
        if lost > reported:
            text = f"{lost - reported} results did not arrive"
            outlets.offer_error(name, datetime.now(UTC), text, "Missed")
            reported = lost


async def _events(events: Any, outlets: Outlets) -> None:
    from smartcam.models import ApplicationChanged, Connected, Disconnected, Reconnected

    state: dict[str, Any] = {"connected": False, "application": None, "reason": None}
    event: CameraEvent
    async for event in events:
        if isinstance(event, (Connected, Reconnected)):
            state |= {"connected": True, "reason": None}
        elif isinstance(event, Disconnected):
            state |= {"connected": False, "reason": event.reason}
            if not event.expected:
                outlets.offer_error(event.camera, event.at, event.reason, "Disconnected")
        elif isinstance(event, ApplicationChanged):
            state |= {"application": event.application}
        else:
            continue
        outlets.state_changed(event.camera, {**state, "at": event.at})
