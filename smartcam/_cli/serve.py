"""``smartcam serve``: the agent of a fleet, which shares the cameras of a fleet file."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import signal
import sys
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import click

from smartcam._cli.log_lines import json_log
from smartcam._cli.options import OUTPUT_OPTIONS, Options, async_command
from smartcam._cli.running import exit_code
from smartcam._cli.systemd import Notifier
from smartcam._cli.terminal import coloured
from smartcam.backoff import Backoff
from smartcam.exceptions import ConnectFailedError, SmartCamError
from smartcam.models import Connected, Disconnected, Reconnected

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Iterator

    from smartcam.exceptions import RecordingError
    from smartcam.fleet import FleetServer
    from smartcam.fleet._inside import FleetChanges
    from smartcam.models import CameraEvent
    from smartcam.recording import FleetRecorder

logger: logging.Logger = logging.getLogger("smartcam.serve")


@click.command(
    help="Connect to the cameras of a fleet file, and share them with any number of programs, "
    "until Ctrl-C or SIGTERM. Prints one line per camera, with its fleet URL, which every "
    "command accepts as a camera. A missing camera has the reason on its line, and is tried "
    "again. Later changes are reported on stderr; with --json on stdout, as the camera's "
    'object. SIGHUP reads the file again, unless stdin is a terminal. Needs the extra "fleet", '
    'and, if the file has a section operations, also the extra "operations".'
)
@click.argument("file", required=False, metavar="FLEET.yaml")
@click.option("--schema", is_flag=True, help="Print the JSON Schema of fleet files, and end.")
@click.option(
    "--log",
    type=click.Choice(["text", "json"]),
    help="Form of the log on stderr; default: as the file says, or text. json: one object "
    "a line, and nothing else.",
)
@async_command(*OUTPUT_OPTIONS, interrupt_code=0, terminate_code=0)
async def serve(file: str | None, schema: bool, log: str | None, options: Options) -> None:
    """Share cameras."""
    import smartcam.fleet
    from smartcam.fleet._inside import fleet_schema, raise_descriptor_limit

    if schema:
        click.echo(json.dumps(fleet_schema(), indent=2))
        return
    if file is None:
        raise click.UsageError("a fleet file is missing: smartcam serve FLEET.yaml, or --schema")
    raise_descriptor_limit()
    if log == "json":  # an error in the file is logged so, too
        with _json_logs(None, options):
            server = smartcam.fleet.serve(file)
    else:
        server = smartcam.fleet.serve(file)
    section = server.file.operations
    log_is_json = (log or (section and section.log)) == "json"
    with _json_logs(server, options) if log_is_json else contextlib.nullcontext():
        await AgentRunner(server, options, log_is_json).run()


@contextlib.contextmanager
def _json_logs(server: FleetServer | None, options: Options) -> Iterator[None]:
    """Write all logs of the block as lines of JSON, and also the error that ends the block."""
    section = None if server is None else server.file.operations
    level = logging.getLevelName(
        "DEBUG" if options.debug else section.level.upper() if section else "INFO"
    )
    with json_log(
        level,
        lambda: "" if server is None else server.name or server.file.agent or "",
        lambda: () if server is None else server.shared_cameras,
    ):
        try:
            yield
        except (SmartCamError, OSError) as exc:
            logger.critical("%s", exc, exc_info=options.debug)
            raise SystemExit(exit_code(exc)) from exc


class AgentRunner:
    """Runs an agent in this process: starts it, prints its events, and reloads it on SIGHUP.

    Args:
        server: the agent.
        options: options of the command.
        log_is_json: whether events are logged as lines of JSON, and not printed for people.
        show: function that reports the start; None: print a line for each camera.
    """

    def __init__(
        self,
        server: FleetServer,
        options: Options,
        log_is_json: bool,
        show: Callable[[], None] | None = None,
    ) -> None:
        self._server, self._options, self._log_is_json = server, options, log_is_json
        self._show: Callable[[], None] = show or self._show_cameras
        self._notifier = Notifier()
        self._is_ready = False

    async def run(self) -> None:
        server, notifier = self._server, self._notifier
        async with contextlib.AsyncExitStack() as stack:
            stack.callback(notifier.close)
            reload_requested = stack.enter_context(_reload_requests())
            await stack.enter_async_context(self._operations_page())
            if server.file.record is not None:
                recorder = _make_recorder(server, self._options, self._log_is_json)
                await stack.enter_async_context(recorder)
            if server.file.outlets is not None:
                from smartcam.fleet._inside import FleetOutlets

                await stack.enter_async_context(FleetOutlets(server, self._notify_outlet))
            await self._start_agent(stack)
            stack.callback(notifier.report_stopping)
            server.reloads.on_reload = self._on_reload
            stack.enter_context(notifier.reporting(self._status))
            await stack.enter_async_context(
                _background_task(self._reload_on_request(reload_requested))
            )
            await server.wait_first_attempts()
            self._is_ready = True
            notifier.report_ready(self._status())
            if server.warning:
                self._warn(server.warning)
            events = server.events()
            self._show()
            async for event in events:
                if self._log_is_json:
                    self._log_event(event)
                if self._options.as_json or not self._log_is_json:
                    report_event(server, event, self._options)

    async def _start_agent(self, stack: contextlib.AsyncExitStack) -> None:
        """Start the agent; while its router does not answer, try again."""
        policy, warned = Backoff(), False
        for delay in policy.delays():
            try:
                await stack.enter_async_context(self._server)
            except ConnectFailedError as exc:
                if self._server.file.endpoints[0] or not policy.transient(exc):
                    raise  # the agent cannot listen, or another try would fail, too
                if not warned:
                    self._warn(f"{exc}; trying again")
                warned = True
            else:
                return
            await asyncio.sleep(delay)

    def _warn(self, text: str) -> None:
        if self._log_is_json:
            logger.warning("%s", text)
        else:
            click.echo(f"{coloured('error', 'warning:')} {text}", err=True)

    def _notify_outlet(self, name: str, reason: str) -> None:
        if not self._log_is_json:  # otherwise it was logged
            text = reason or "delivers again"
            click.echo(f"{datetime.now(UTC).astimezone():%H:%M:%S} outlet {name}: {text}", err=True)

    def _show_cameras(self) -> None:
        server = self._server
        if not server.file.cameras:
            url = server.address.url
            router: dict[str, Any] = {"url": url, "router": True}
            self._print("", router, f"{url}  a router, without cameras", connected=True)
        for name in [*server.shared_cameras]:
            value = _camera_data(server, name)
            reason = "" if value["connected"] else f"  not connected: {value['reason']}"
            self._print(name, value, f"{value['url']}{reason}", connected=value["connected"])

    @contextlib.asynccontextmanager
    async def _operations_page(self) -> AsyncIterator[None]:
        """Serve health and metrics while the block runs, if the file asks for them."""
        section = self._server.file.operations
        if section is None or section.endpoint is None:
            yield
            return
        from smartcam.web import OperationsSite

        async with OperationsSite(self._server) as site:
            logger.info("health and numbers are at port %d of %s", site.port, section.endpoint[0])
            yield

    def _print(self, camera: str, value: dict[str, Any], text: str, *, connected: bool) -> None:
        if self._log_is_json:
            level = logging.INFO if connected else logging.WARNING
            logger.log(level, "shared: %s", text, extra={"camera": camera})
        if self._options.as_json or not self._log_is_json:
            self._options.show(value, text)

    def _log_event(self, event: CameraEvent) -> None:
        extra = {"camera": event.camera}
        if event.camera not in self._server.shared_cameras:
            return  # the camera was removed from the file
        if isinstance(event, Disconnected):
            logger.warning("not connected: %s", event.reason, extra=extra)
        elif isinstance(event, (Connected, Reconnected)):
            logger.info("connected", extra=extra)

    # ------------------------------------------------------------------ reloads

    async def _reload_on_request(self, reload_requested: asyncio.Event) -> None:
        """Read the file again after each request; requests during a reload count as one."""
        while True:
            await reload_requested.wait()
            reload_requested.clear()
            with contextlib.suppress(SmartCamError):  # the error was reported
                await self._server.reload()

    def _on_reload(self, outcome: FleetChanges | SmartCamError | None) -> None:
        if outcome is None:
            if self._is_ready:
                self._notifier.report_reloading("reading the fleet file again")
            return
        if self._is_ready:
            self._notifier.report_ready(self._status())
        if not self._log_is_json:  # otherwise it was logged
            failed = isinstance(outcome, Exception)
            text = (
                f"not reloaded, all stays as it was: {outcome}"
                if failed
                else f"reloaded: {outcome}"
            )
            with contextlib.suppress(OSError):  # stdout is closed
                click.echo(text, err=True)

    def _status(self) -> str:
        server = self._server
        cameras = server.shared_cameras.values()
        text = f"{sum(camera.connected for camera in cameras)} of {len(cameras)} cameras connected"
        if server.agent is not None and not server.is_connected:
            text = f"not on the bus; {text}"
        last = server.reloads.last
        return f"{text}; not reloaded: {last}" if isinstance(last, Exception) else text


@contextlib.contextmanager
def _reload_requests() -> Iterator[asyncio.Event]:
    """Yield an event that SIGHUP sets; if stdin is a terminal, SIGHUP ends the program instead."""
    reload_requested, loop = asyncio.Event(), asyncio.get_running_loop()
    number = getattr(signal, "SIGHUP", None)
    if number is None or (sys.stdin is not None and sys.stdin.isatty()):
        yield reload_requested
        return
    with contextlib.suppress(NotImplementedError):
        loop.add_signal_handler(number, reload_requested.set)
    try:
        yield reload_requested
    finally:
        with contextlib.suppress(NotImplementedError):
            loop.remove_signal_handler(number)
            signal.signal(number, signal.SIG_IGN)  # the program is ending


@contextlib.asynccontextmanager
async def _background_task(work: Any) -> AsyncIterator[None]:
    """Run a coroutine in a task while the block runs."""
    task = asyncio.get_running_loop().create_task(work)
    try:
        yield
    finally:
        task.cancel()
        await asyncio.wait({task})


def _make_recorder(server: FleetServer, options: Options, log_is_json: bool) -> FleetRecorder:
    """Return the recorder of the cameras; it prints a line when it fails and when it recovers."""
    from smartcam.recording import FleetRecorder

    def show_trouble(trouble: RecordingError | None) -> None:
        lost = {name: counts.lost for name, counts in recorder.counts.items() if counts.lost}
        value = {
            "recordings": str(recorder.path),
            "recording": trouble is None,
            "reason": None if trouble is None else str(trouble),
            "lost": lost,
            "at": datetime.now(UTC),
        }
        if trouble is None:
            text = f"records are written again; {sum(lost.values())} records were not written"
        else:
            text = f"{trouble}; nothing is recorded until the disk works again"
        if log_is_json:
            logger.log(logging.INFO if trouble is None else logging.ERROR, "%s", text)
        if options.as_json:
            options.show(value, "")
        elif not log_is_json:
            click.echo(f"{datetime.now(UTC).astimezone():%H:%M:%S} {text}", err=True)

    recorder = FleetRecorder(server, on_trouble=show_trouble)
    return recorder


async def share(server: FleetServer, options: Options) -> None:
    """Print the URLs of a started agent's cameras, and then each event, until cancelled."""
    await server.wait_first_attempts()
    events = server.events()
    for name in server.shared_cameras:
        value = _camera_data(server, name)
        reason = "" if value["connected"] else f"  not connected: {value['reason']}"
        options.show(value, f"{value['url']}{reason}")
    async for event in events:
        report_event(server, event, options)


def _camera_data(server: FleetServer, name: str) -> dict[str, Any]:
    """Return the state of one of the agent's cameras as values for JSON."""
    camera = server.shared_cameras[name]
    connected = camera.connected
    failure = camera.failure or "it is tried for the first time"
    return {
        "url": server.address.of(name).url,
        "name": name,
        "camera": camera.client.url,
        "connected": connected,
        "application": camera.client.active_application if connected else None,
        "reason": None if connected else str(failure).removeprefix(f"{name}: "),
    }


def report_event(server: FleetServer, event: CameraEvent, options: Options) -> None:
    """Report that a camera was connected, or lost."""
    is_shared = event.camera in server.shared_cameras
    if not (is_shared and isinstance(event, (Connected, Disconnected, Reconnected))):
        return
    value = _camera_data(server, event.camera)
    if isinstance(event, Disconnected):
        value |= {"connected": False, "application": None, "reason": event.reason}
        text = f"not connected: {event.reason}"
    else:
        value |= {"connected": True, "reason": None}
        text = "connected"
    if options.as_json:
        options.show({**value, "at": event.at}, "")
    else:
        click.echo(f"{event.at.astimezone():%H:%M:%S} {event.camera}: {text}", err=True)
