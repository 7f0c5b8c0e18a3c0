"""The emulator's site: its page, and an HTTP call for everything the page does."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, TypeAdapter, model_validator

from smartcam.emulator.faults import Fault
from smartcam.emulator.scene import PIECES, TablePose
from smartcam.exceptions import ConfigurationError
from smartcam.web import serialize
from smartcam.web.errors import RefusedError
from smartcam.web.feed import Watcher
from smartcam.web.routes import Ask, Call, as_table
from smartcam.web.site import API, Site
from smartcam.web.streams import is_open

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping
    from types import TracebackType
    from typing import Self

    from aiohttp import web

    from smartcam.emulator import EmulatedCamera

__all__ = [
    "CALLS",
    "LOOK_AGAIN",
    "MAX_ENTRIES",
    "MAX_NAMES",
    "MAX_PARTS",
    "MAX_WAIT",
    "MAX_WAITING",
    "EmulatorSite",
]

MAX_ENTRIES = 1000
"""Log entries that one answer tells; ``next`` says where to go on."""

MAX_WAIT = 30.0
"""Seconds that a call waits for a log entry at most."""

MAX_WAITING = 16
"""Calls that wait for one at a time. With the event streams they leave half of the places free."""

LOOK_AGAIN = 0.02
"""Seconds between two looks for it."""

MAX_PARTS = 100
"""Parts on a table; a result container has room for about 900 localizations."""

MAX_NAMES = 20
"""Names of cameras that a refusal lists."""


class EmulatorSite:
    """A page and HTTP calls that show and control emulated cameras.

    It runs in the emulators' own event loop. They may be started and stopped on their own; the
    mapping is looked into at each call.

    ::

        async with EmulatedCamera() as emulator, EmulatorSite({"camera": emulator}) as site:
            site.url    # http://127.0.0.1:PORT/

    Args:
        cameras: the cameras by the names that stand in paths.
        host: address to listen on; nothing but this.
        port: port to listen on, 0 for a free one.
        token: what every call must carry in ``Authorization: Bearer``: 16 letters, digits, ``-``
            and ``_`` at least. None: nothing on a loopback address; on any other one is made.

    Raises:
        ConfigurationError: a name or the token cannot be used.
    """

    def __init__(
        self,
        cameras: Mapping[str, EmulatedCamera],
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
    ) -> None:
        for name in cameras:
            if not name.isprintable() or name in {"", ".", ".."}:
                raise ConfigurationError(f"web: {name!r} cannot stand in a path: name the camera")
        self.cameras: Mapping[str, EmulatedCamera] = cameras
        self._site = Site(self, CALLS, "emulator", host=host, port=port, token=token)
        self._waiting = 0

    @property
    def url(self) -> str:
        """Address of the page; with a token it stands behind ``#``."""
        return self._site.url

    @property
    def api(self) -> str:
        """Address in front of the calls' paths, ``http://HOST:PORT``."""
        return self._site.base

    @property
    def token(self) -> str | None:
        """What calls must carry, None for nothing."""
        return self._site.token

    @property
    def port(self) -> int:
        """The port it listens on; the one given until it is started."""
        return self._site.port

    async def __aenter__(self) -> Self:
        await self.start()
        return self

    async def __aexit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.stop()

    async def start(self) -> None:
        """Open the port; does nothing if it is started already.

        Raises:
            ConfigurationError: it cannot listen there.

        Cancellation: leaves it stopped.
        """
        await self._site.start()

    async def stop(self) -> None:
        """Close the port, every stream and every connection; does nothing if stopped.

        Cancellation: takes effect when all is closed, in less than half a second.
        """
        await self._site.stop()

    async def pause(self, seconds: float) -> bool:
        """Wait for some time; True at once where the site stops."""
        return await self._site.streams.pause(seconds)

    async def wait_for(
        self, request: web.Request, condition: Callable[[], bool], seconds: float
    ) -> None:
        """Wait until something holds, for some time, and as long as site and client are there.

        Raises:
            RefusedError: 503, :data:`MAX_WAITING` calls wait already.
        """
        if self._waiting >= MAX_WAITING:
            raise RefusedError(503, f"waiting call {MAX_WAITING + 1}", f"{MAX_WAITING} at one time")
        self._waiting += 1
        try:
            loop = asyncio.get_running_loop()
            deadline = loop.time() + seconds
            while loop.time() < deadline and is_open(request) and not condition():
                if await self.pause(LOOK_AGAIN):
                    break
        finally:
            self._waiting -= 1

    def serve_events(self, request: web.Request, watcher: Watcher) -> Awaitable[web.StreamResponse]:
        """Serve an event stream."""
        return self._site.streams.serve(request, watcher.look)


# ---------------------------------------------------------------------- what calls take


class _Body(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid", strict=True)


class _Application(_Body):
    id: int = Field(ge=1, le=0xFFFFFFFF)
    running: bool = False


class _Reboot(_Body):
    seconds: float | None = Field(default=None, ge=0, le=3600, allow_inf_nan=False)


class _Conditions(_Body):
    overheat: bool | None = None
    system_error: bool | None = None

    @model_validator(mode="after")
    def _check(self) -> _Conditions:
        if self.overheat is None and self.system_error is None:
            raise ValueError("overheat, system_error or both, true or false")
        return self


class _Endian(_Body):
    endian: int = Field(ge=0, le=0xFFFFFFFF)


_Metres = Annotated[float, Field(ge=-10, le=10, allow_inf_nan=False)]


class _Pose(_Body):
    x: _Metres
    y: _Metres
    theta: float = Field(default=0.0, ge=-1000, le=1000, allow_inf_nan=False)


class _Place(BaseModel):
    """Where a look into the log begins."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")

    since: int | None = Field(default=None, ge=0, le=2**63 - 1)


class _Part(_Place):
    """Which part of the log is wanted."""

    limit: int = Field(default=MAX_ENTRIES, ge=1, le=MAX_ENTRIES)
    wait: float = Field(default=0.0, ge=0, le=MAX_WAIT, allow_inf_nan=False)


def _as_list(value: object) -> object:
    return [value] if isinstance(value, dict) else value


_FAULTS: TypeAdapter[Any] = TypeAdapter(Annotated[list[Fault], BeforeValidator(_as_list)])


# ---------------------------------------------------------------------- what calls do


def _name(site: EmulatorSite, ask: Ask) -> str:
    name = ask.path["camera"]
    if name not in site.cameras:
        known = list(site.cameras)
        more = ", ..." if len(known) > MAX_NAMES else ""
        raise RefusedError(
            404, f"no camera is called {name!r}", f"{', '.join(known[:MAX_NAMES])}{more}"
        )
    return name


def _emulator(site: EmulatorSite, ask: Ask) -> EmulatedCamera:
    return site.cameras[_name(site, ask)]


def _calls(_site: EmulatorSite, _ask: Ask) -> object:
    return {"calls": as_table(CALLS)}


def _kinds(_site: EmulatorSite, _ask: Ask) -> object:
    return {"kinds": serialize.kinds()}


def _cameras(site: EmulatorSite, _ask: Ask) -> object:
    return {"cameras": [serialize.camera_row(name, one) for name, one in site.cameras.items()]}


def _state(site: EmulatorSite, ask: Ask) -> object:
    name = _name(site, ask)
    emulator = site.cameras[name]
    return {
        **serialize.camera_state(name, emulator),
        **serialize.times(emulator),
        "log": serialize.log_range(emulator),
    }


def _trigger(site: EmulatorSite, ask: Ask) -> object:
    taken = _emulator(site, ask).device.trigger()
    return {"taken": taken, "camera": _state(site, ask)}


def _start(site: EmulatorSite, ask: Ask) -> object:
    _emulator(site, ask).device.start()
    return {"camera": _state(site, ask)}


def _stop(site: EmulatorSite, ask: Ask) -> object:
    _emulator(site, ask).device.stop()
    return {"camera": _state(site, ask)}


def _application(site: EmulatorSite, ask: Ask) -> object:
    device = _emulator(site, ask).device
    wanted: _Application = ask.body
    if wanted.id not in device.applications:
        known = ", ".join(str(one) for one in device.applications)
        field = {"field": "id", "came": str(wanted.id), "expected": f"one of {known}"}
        raise RefusedError(422, f"application {wanted.id}", f"one of {known}", (field,))
    if not device.switch_application(wanted.id, running=wanted.running):
        raise RefusedError(409, f"the camera is {device.mode.value}", "it to be stopped or running")
    return {"camera": _state(site, ask)}


def _reboot(site: EmulatorSite, ask: Ask) -> object:
    wanted: _Reboot = ask.body
    _emulator(site, ask).device.reboot(wanted.seconds)
    return {"camera": _state(site, ask)}


def _conditions(site: EmulatorSite, ask: Ask) -> object:
    device = _emulator(site, ask).device
    for name, bit in serialize.CONDITIONS.items():
        on = getattr(ask.body, name)
        if on is not None:
            device.set_condition(bit, on)
    return {"camera": _state(site, ask)}


def _endian(site: EmulatorSite, ask: Ask) -> object:
    wanted: _Endian = ask.body
    _emulator(site, ask).device.set_endian(wanted.endian)
    return {"camera": _state(site, ask)}


def _faults(site: EmulatorSite, ask: Ask) -> object:
    return serialize.faults_state(_emulator(site, ask))


def _inject(site: EmulatorSite, ask: Ask) -> object:
    _emulator(site, ask).inject(*ask.body)
    return _faults(site, ask)


def _clear_faults(site: EmulatorSite, ask: Ask) -> object:
    _emulator(site, ask).clear_faults()
    return _faults(site, ask)


def _command(site: EmulatorSite, ask: Ask) -> object:
    emulator, name = _emulator(site, ask), ask.path["command"]
    if name not in emulator.commands:
        known = ", ".join(emulator.commands) or "none: its scenario's timeline has no command"
        raise RefusedError(404, f"no command is called {name!r}", known)
    emulator.command(name)
    return {"camera": _state(site, ask)}


def _scene(site: EmulatorSite, ask: Ask) -> object:
    emulator = _emulator(site, ask)
    return {**serialize.scene_state(emulator.scene), "reported": serialize.reported(emulator)}


def _put_part(site: EmulatorSite, ask: Ask) -> object:
    pieces, name = _emulator(site, ask).scene.pieces, ask.path["part"]
    if not (name.isascii() and name.isprintable() and len(name) <= 50):
        raise RefusedError(
            422, f"the part {name!r}", "a name of 1 to 50 printable ASCII characters"
        )
    if name not in pieces and len(pieces) >= MAX_PARTS:
        raise RefusedError(422, f"part {MAX_PARTS + 1}", f"{MAX_PARTS} parts on a table at most")
    wanted: _Pose = ask.body
    pieces[name] = TablePose(wanted.x, wanted.y, wanted.theta)
    return _scene(site, ask)


def _remove_part(site: EmulatorSite, ask: Ask) -> object:
    pieces, name = _emulator(site, ask).scene.pieces, ask.path["part"]
    if pieces.pop(name, None) is None:
        known = ", ".join(pieces) or "nothing: the table is empty"
        raise RefusedError(404, f"no part is called {name!r}", known)
    return _scene(site, ask)


def _reset_scene(site: EmulatorSite, ask: Ask) -> object:
    pieces = _emulator(site, ask).scene.pieces
    pieces.clear()
    pieces.update(PIECES)
    return _scene(site, ask)


async def _log(site: EmulatorSite, ask: Ask) -> object:
    emulator, part = _emulator(site, ask), ask.query
    since: int = part.since or 0

    def came() -> bool:
        return bool(emulator.log.since(since, 1)[0])

    if part.wait:
        await site.wait_for(ask.request, came, part.wait)
    return serialize.log_part(emulator, since, part.limit)[0]


def _log_entry(site: EmulatorSite, ask: Ask) -> object:
    emulator, text = _emulator(site, ask), ask.path["serial"]
    serial = int(text) if text.isdecimal() and len(text) < 20 else -1
    entries, count = emulator.log.since(serial, 1)
    first = count - len(emulator.log)
    if not entries or serial < first:
        there = f"{first} to {count - 1}" if len(emulator.log) else "none"
        raise RefusedError(404, f"log entry {text!r}", f"one that is there: {there}")
    return serialize.camera_entry(serial, entries[0], emulator, whole=True)


def _clear_log(site: EmulatorSite, ask: Ask) -> object:
    emulator = _emulator(site, ask)
    emulator.log.clear()
    return {"next": serialize.log_count(emulator)}


def _events(site: EmulatorSite, ask: Ask) -> object:
    name = _name(site, ask)
    since: int | None = ask.query.since
    last = ask.request.headers.get("Last-Event-ID", "")
    if since is None and last.isdecimal() and len(last) < 20:
        since = int(last)
    return site.serve_events(ask.request, Watcher(name, site.cameras[name], since))


_CAMERA = f"{API}/cameras/{{camera}}"

_Row = Call["EmulatorSite"]

CALLS: tuple[_Row, ...] = (
    _Row(method="GET", path=API, about="These calls.", handler=_calls),
    _Row(method="GET", path=f"{API}/cameras", about="All cameras, in short.", handler=_cameras),
    _Row(method="GET", path=_CAMERA, about="All that one camera's state is.", handler=_state),
    _Row(
        method="POST",
        path=f"{_CAMERA}/trigger",
        about="Trigger by the digital input; `taken` tells whether an inspection began.",
        handler=_trigger,
    ),
    _Row(method="POST", path=f"{_CAMERA}/start", about="Enter run mode.", handler=_start),
    _Row(method="POST", path=f"{_CAMERA}/stop", about="Leave run mode.", handler=_stop),
    _Row(
        method="POST",
        path=f"{_CAMERA}/application",
        about="Load another application behind the client's back; 409 while one is loaded.",
        handler=_application,
        body=_Application,
        sample='{"id": 7, "running": true}',
    ),
    _Row(
        method="POST",
        path=f"{_CAMERA}/reboot",
        about="Restart it, as by its power switch; without a body as the quirk says.",
        handler=_reboot,
        body=_Reboot,
        optional=True,
        sample='{"seconds": 0.5}',
    ),
    _Row(
        method="POST",
        path=f"{_CAMERA}/conditions",
        about="Set or clear Overheat and System Error.",
        handler=_conditions,
        body=_Conditions,
        sample='{"overheat": true}',
    ),
    _Row(
        method="POST",
        path=f"{_CAMERA}/endian",
        about="Byte order of results: 0 little, 1 big.",
        handler=_endian,
        body=_Endian,
        sample='{"endian": 1}',
    ),
    _Row(
        method="GET",
        path=f"{API}/faults",
        about="Every kind of fault, with the JSON Schema of its fields.",
        handler=_kinds,
    ),
    _Row(
        method="GET",
        path=f"{_CAMERA}/faults",
        about="Faults that wait, and the last ones that have happened.",
        handler=_faults,
    ),
    _Row(
        method="POST",
        path=f"{_CAMERA}/faults",
        about="Inject a fault, or a list of them: all or, where one is wrong, none.",
        handler=_inject,
        body=_FAULTS,
        sample='{"kind": "drop", "on": "ResultContainer"}',
    ),
    _Row(
        method="DELETE",
        path=f"{_CAMERA}/faults",
        about="Forget the faults that wait, end those that last.",
        handler=_clear_faults,
    ),
    _Row(
        method="POST",
        path=f"{_CAMERA}/commands/{{command}}",
        about="Let that row of the scenario's timeline happen.",
        handler=_command,
    ),
    _Row(
        method="GET",
        path=f"{_CAMERA}/scene",
        about="The table: parts at their true poses, the field of view, and what was reported.",
        handler=_scene,
    ),
    _Row(
        method="PUT",
        path=f"{_CAMERA}/scene/parts/{{part}}",
        about="Put a part there, or move it: metres and radians.",
        handler=_put_part,
        body=_Pose,
        sample='{"x": 0.2, "y": 0.1, "theta": 0.0}',
    ),
    _Row(
        method="DELETE",
        path=f"{_CAMERA}/scene/parts/{{part}}",
        about="Take a part off the table.",
        handler=_remove_part,
    ),
    _Row(
        method="POST",
        path=f"{_CAMERA}/scene/reset",
        about="Put all parts back to where they lay at first.",
        handler=_reset_scene,
    ),
    _Row(
        method="GET",
        path=f"{_CAMERA}/log",
        about="Log entries from serial `?since=` on, `?limit=` at most; `next` is the serial to "
        "go on with. With `?wait=` seconds it waits for the first one.",
        handler=_log,
        query=_Part,
    ),
    _Row(
        method="GET",
        path=f"{_CAMERA}/log/{{serial}}",
        about="One log entry, with all of its payload.",
        handler=_log_entry,
    ),
    _Row(method="DELETE", path=f"{_CAMERA}/log", about="Empty the log.", handler=_clear_log),
    _Row(
        method="GET",
        path=f"{_CAMERA}/events",
        about="What happens, as server-sent events: `camera`, `scene`, `faults`, `log`, `clock`; "
        "the log from `?since=` on, else from now.",
        handler=_events,
        query=_Place,
    ),
)
"""All calls; ``docs/control.md`` shows them."""
