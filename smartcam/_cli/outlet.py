"""``smartcam outlet``: deliver a camera's results to brokers and databases."""

from __future__ import annotations

import asyncio
import contextlib
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from smartcam._cli.options import CAMERA_OPTIONS, CONNECT_WARNING, Options, async_command
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
    'has a section "outlets" as in a fleet file. Prints a line for each trouble, '
    f"and the counts at the end. {CONNECT_WARNING}"
)
@click.argument("url")
@click.argument("file", metavar="FILE.yaml")
@async_command(
    *("--application", "--interpret-as", "--y-down", "--calibration", "--name", "--seconds"),
    *CAMERA_OPTIONS,
    interrupt_code=0,
    terminate_code=0,
)
async def outlet(url: str, file: str, options: Options) -> None:
    """Deliver results."""
    from smartcam._cli.live import keep_open
    from smartcam.outlets import Outlets
    from smartcam.outlets._inside import OutletsFile

    outlets_file = OutletsFile.load(file)
    source = _OutletSource(options)
    outlets = Outlets(
        outlets_file.outlets,
        Path(file).parent,
        columns=source.columns,
        command=source.command,
        on_trouble=source.report_trouble,
        cameras=source.cameras,
        application_names=source.application_names,
    )
    url = await options.locate_url(url)
    with options.cameras(url, reconnect=Backoff()) as make_camera:
        async with outlets:
            try:
                with contextlib.suppress(TimeoutError):  # --seconds are over
                    async with asyncio.timeout(options.seconds):
                        camera = make_camera()
                        await source.use_camera(camera, "", outlets)
                        replace_camera = source.make_replacer(outlets)
                        await keep_open(camera, make_camera, replace_camera, source.show_open)
            finally:
                await source.stop()
        for name, state in outlets.states.items():
            options.show({"outlet": name, **state.counts.fields()}, f"{name}: {state.counts}")


class _OutletSource:
    """Feeds the outlets with a camera's results, errors and states."""

    def __init__(self, options: Options) -> None:
        self._options = options
        self.camera: Camera[Any] | None = None
        self._tasks: list[asyncio.Task[None]] = []

    def make_replacer(self, outlets: Outlets) -> Any:
        async def replace_camera(camera: Camera[Any], reason: str) -> None:
            await self.use_camera(camera, reason, outlets)

        return replace_camera

    async def use_camera(self, camera: Camera[Any], reason: str, outlets: Outlets) -> None:
        """Pass on the results and events of this camera instead of an earlier camera's."""
        await self.stop()
        self.camera = camera
        if reason:
            click.echo(f"note: {reason}; trying again", err=True)
        loop = asyncio.get_running_loop()
        results, events = camera.results(max_queue=100_000), camera.events()
        self._tasks = [
            loop.create_task(_pass_results(camera.name, results, outlets)),
            loop.create_task(_pass_events(events, outlets)),
        ]

    def show_open(self) -> None:
        if self.camera is not None:
            self._options.show({"camera": self.camera.url}, f"camera: {self.camera.url}")

    async def stop(self) -> None:
        tasks, self._tasks = self._tasks, []
        for task in tasks:
            task.cancel()
        if tasks:
            await asyncio.wait(tasks)

    def application_names(self, _camera: str) -> Mapping[str, int]:
        return {} if self.camera is None else self.camera.settings.application_names

    def columns(self, _camera: str, application: int) -> Any:
        from smartcam._client._inside import Interpretation
        from smartcam.outlets._inside import columns_of

        options = self._options
        spec = options.interpret_as or "raw"
        if self.camera is not None:  # its settings also have layouts of its own
            spec = self.camera.settings.interpret_as
        read = Interpretation(spec, lenient=False, y_down=options.y_down)
        return columns_of(read.interpreter(application))

    async def command(self, name: str, verb: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
        from smartcam.exceptions import ConfigurationError
        from smartcam.outlets._inside import do_command

        if self.camera is None or name != self.camera.name:
            raise ConfigurationError(f"there is no camera {name!r:.120} here")
        return await do_command(self.camera, verb, arguments)

    def cameras(self) -> dict[str, bool | None]:
        return {} if self.camera is None else {self.camera.name: None}

    def report_trouble(self, name: str, reason: str) -> None:
        text = reason or "delivers again"
        click.echo(f"{datetime.now(UTC).astimezone():%H:%M:%S} outlet {name}: {text}", err=True)


async def _pass_results(name: str, results: Any, outlets: Outlets) -> None:
    """Pass results on to the outlets; report as an error that the subscription lost results."""
    reported_count = 0
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
        counts = results.statistics()
        lost_count = counts.dropped + counts.missed
        if lost_count > reported_count:
            text = f"{lost_count - reported_count} results did not arrive"
            outlets.offer_error(name, datetime.now(UTC), text, "Missed")
            reported_count = lost_count


async def _pass_events(events: Any, outlets: Outlets) -> None:
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
