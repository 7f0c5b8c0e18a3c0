"""Define the emulator's site: a page for emulated cameras, and an HTTP call for each action."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, TypeAdapter, model_validator

from smartcam.emulator import TablePose
from smartcam.emulator._inside import CONDITIONS, PIECES
from smartcam.emulator.faults import Fault
from smartcam.exceptions import ConfigurationError
from smartcam.web import _serialize as serialize
from smartcam.web._errors import RefusedError
from smartcam.web._feed import EmulatorWatcher
from smartcam.web._routes import CallBody, CallRequest, Calls
from smartcam.web._site import API, Site
from smartcam.web._streams import is_open

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from aiohttp import web

    from smartcam.emulator import TableScene, WireCamera

MAX_ENTRIES = 1000
"""Largest number of log entries in one answer; its ``next`` is the serial to continue with."""

MAX_WAIT = 30.0
"""Seconds that a call may wait for a log entry."""

MAX_WAITING_CALLS = 16
"""Largest number of calls that may wait for a log entry at the same time. Together with the event
streams they take half of the connections."""

LOG_POLL_INTERVAL = 0.02
"""Seconds between two checks for a new log entry."""

MAX_PARTS = 100
"""Largest number of parts on a table; a result container has room for about 900 localizations."""

MAX_NAMES = 20
"""Largest number of names of cameras that a refusal lists."""


class EmulatorSite(Site):
    """A page and HTTP calls that show and control emulated cameras.

    The site runs in the emulators' event loop. Emulators may be started, stopped, added and removed
    at any time, since each call looks up the camera in ``cameras``.

    ::

        async with EmulatedCamera() as emulator, EmulatorSite({"camera": emulator}) as site:
            site.url    # http://127.0.0.1:PORT/

    Args:
        cameras: the cameras by their names in paths.
        host: address to listen on, without a scheme or a port.
        port: port to listen on, 0 for a free one.
        token: token that every call must carry in ``Authorization: Bearer``: at least 16 letters,
            digits, ``-`` and ``_``. None: no token on a loopback address; else one is made.

    Raises:
        ConfigurationError: a name or the token cannot be used.
    """

    def __init__(
        self,
        cameras: Mapping[str, WireCamera],
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        token: str | None = None,
    ) -> None:
        for name in cameras:
            if not name.isprintable() or name in {"", ".", ".."}:
                raise ConfigurationError(f"web: {name!r} cannot stand in a path: name the camera")
        super().__init__(CALLS, "emulator", host=host, port=port, token=token)
        self.cameras: Mapping[str, WireCamera] = cameras
        self._waiting_count = 0

    async def wait_for(
        self, request: web.Request, condition: Callable[[], bool], seconds: float
    ) -> None:
        """Wait until a condition is true, at most for some seconds.

        The wait also ends when the site stops or the client disconnects.

        Raises:
            RefusedError: 503, :data:`MAX_WAITING_CALLS` calls wait already.
        """
        if self._waiting_count >= MAX_WAITING_CALLS:
            raise RefusedError(
                503, f"waiting call {MAX_WAITING_CALLS + 1}", f"{MAX_WAITING_CALLS} at most"
            )
        self._waiting_count += 1
        try:
            loop = asyncio.get_running_loop()
            deadline = loop.time() + seconds
            while loop.time() < deadline and is_open(request) and not condition():
                if await self.streams.wait_closing(LOG_POLL_INTERVAL):
                    break
        finally:
            self._waiting_count -= 1


# ---------------------------------------------------------------------- arguments of calls


class _ApplicationBody(CallBody):
    id: int = Field(ge=1, le=0xFFFFFFFF)
    running: bool = False


class _RebootBody(CallBody):
    seconds: float | None = Field(default=None, ge=0, le=3600, allow_inf_nan=False)


class _Conditions(CallBody):
    overheat: bool | None = None
    system_error: bool | None = None

    @model_validator(mode="after")
    def _check(self) -> _Conditions:
        if self.overheat is None and self.system_error is None:
            raise ValueError("overheat, system_error or both, true or false")
        return self


class _Endian(CallBody):
    endian: int = Field(ge=0, le=0xFFFFFFFF)


_Metres = Annotated[float, Field(ge=-10, le=10, allow_inf_nan=False)]


class _PartPose(CallBody):
    x: _Metres
    y: _Metres
    theta: float = Field(default=0.0, ge=-1000, le=1000, allow_inf_nan=False)


class _LogStart(BaseModel):
    """The serial of the log entry at which an answer begins."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")

    since: int | None = Field(default=None, ge=0, le=2**63 - 1)


class _LogQuery(_LogStart):
    """A query for a part of the log."""

    limit: int = Field(default=MAX_ENTRIES, ge=1, le=MAX_ENTRIES)
    wait: float = Field(default=0.0, ge=0, le=MAX_WAIT, allow_inf_nan=False)


def _as_list(value: object) -> object:
    return [value] if isinstance(value, dict) else value


_FAULTS: TypeAdapter[Any] = TypeAdapter(Annotated[list[Fault], BeforeValidator(_as_list)])


# ---------------------------------------------------------------------- calls

CALLS: Calls[EmulatorSite] = Calls()
"""All calls; ``docs/control.md`` shows them."""

_CAMERA = f"{API}/cameras/{{camera}}"


def _camera_name(site: EmulatorSite, call: CallRequest) -> str:
    name = call.path["camera"]
    if name not in site.cameras:
        known = list(site.cameras)
        more = ", ..." if len(known) > MAX_NAMES else ""
        raise RefusedError(
            404, f"no camera is called {name!r}", f"{', '.join(known[:MAX_NAMES])}{more}"
        )
    return name


def _emulator(site: EmulatorSite, call: CallRequest) -> WireCamera:
    return site.cameras[_camera_name(site, call)]


def _device_method(site: EmulatorSite, call: CallRequest, action: str) -> Any:
    """Return a method of an operator at the camera; RefusedError: the camera does not have it."""
    emulator = _emulator(site, call)
    if not hasattr(emulator.device, action):
        abilities = ", ".join(serialize.abilities(emulator)) or "nothing of the kind"
        raise RefusedError(409, f"{action} of a camera that speaks {emulator.dialect}", abilities)
    return getattr(emulator.device, action)


def _table(site: EmulatorSite, call: CallRequest) -> TableScene:
    """Return the table that a camera sees; RefusedError: it has no table."""
    scene = _emulator(site, call).table
    if scene is None:
        raise RefusedError(409, "a camera without a scene", "one that looks at a table")
    return scene


@CALLS.add("GET", API)
def _calls(_site: EmulatorSite, _call: CallRequest) -> object:
    """List the calls of this page."""
    return {"calls": CALLS.as_json()}


@CALLS.add("GET", f"{API}/cameras")
def _cameras(site: EmulatorSite, _call: CallRequest) -> object:
    """All cameras, in short."""
    return {
        "cameras": [serialize.camera_row(name, camera) for name, camera in site.cameras.items()]
    }


@CALLS.add("GET", _CAMERA)
def _state(site: EmulatorSite, call: CallRequest) -> object:
    """The whole state of one camera."""
    name = _camera_name(site, call)
    emulator = site.cameras[name]
    return {
        **serialize.camera_state(name, emulator),
        **serialize.times(emulator),
        "log": serialize.log_range(emulator),
    }


@CALLS.add("POST", f"{_CAMERA}/trigger")
def _trigger(site: EmulatorSite, call: CallRequest) -> object:
    """Trigger by the digital input; `taken`: whether an inspection began."""
    taken = _device_method(site, call, "trigger")()
    return {"taken": taken, "camera": _state(site, call)}


@CALLS.add("POST", f"{_CAMERA}/start")
def _start(site: EmulatorSite, call: CallRequest) -> object:
    """Enter run mode."""
    _device_method(site, call, "start")()
    return {"camera": _state(site, call)}


@CALLS.add("POST", f"{_CAMERA}/stop")
def _stop(site: EmulatorSite, call: CallRequest) -> object:
    """Leave run mode."""
    _device_method(site, call, "stop")()
    return {"camera": _state(site, call)}


@CALLS.add(
    "POST", f"{_CAMERA}/application", body=_ApplicationBody, sample='{"id": 7, "running": true}'
)
def _application(site: EmulatorSite, call: CallRequest) -> object:
    """Load another application, like an operator; 409 while another is being loaded."""
    switch, emulator = _device_method(site, call, "switch_application"), _emulator(site, call)
    body: _ApplicationBody = call.body
    if body.id not in emulator.application_ids:
        known = ", ".join(str(ident) for ident in emulator.application_ids)
        field = {"field": "id", "received": str(body.id), "expected": f"one of {known}"}
        raise RefusedError(422, f"application {body.id}", f"one of {known}", (field,))
    if not switch(body.id, running=body.running):
        mode = emulator.device.mode
        state = getattr(mode, "value", mode)
        raise RefusedError(409, f"the camera is {state}", "a camera that is stopped or running")
    return {"camera": _state(site, call)}


@CALLS.add("POST", f"{_CAMERA}/reboot", body=_RebootBody, optional=True, sample='{"seconds": 0.5}')
def _reboot(site: EmulatorSite, call: CallRequest) -> object:
    """Restart the camera, as by its power switch; default: for the time of quirk `reboot_time`."""
    body: _RebootBody = call.body
    _device_method(site, call, "reboot")(body.seconds)
    return {"camera": _state(site, call)}


@CALLS.add("POST", f"{_CAMERA}/conditions", body=_Conditions, sample='{"overheat": true}')
def _conditions(site: EmulatorSite, call: CallRequest) -> object:
    """Set or clear Overheat and System Error."""
    set_condition = _device_method(site, call, "set_condition")
    for name, bit in CONDITIONS.items():
        on = getattr(call.body, name)
        if on is not None:
            set_condition(bit, on)
    return {"camera": _state(site, call)}


@CALLS.add("POST", f"{_CAMERA}/endian", body=_Endian, sample='{"endian": 1}')
def _endian(site: EmulatorSite, call: CallRequest) -> object:
    """Byte order of results: 0 little, 1 big."""
    body: _Endian = call.body
    _device_method(site, call, "set_endian")(body.endian)
    return {"camera": _state(site, call)}


@CALLS.add("GET", f"{API}/faults")
def _kinds(_site: EmulatorSite, _call: CallRequest) -> object:
    """Every kind of fault, with the JSON Schema of its fields."""
    return {"kinds": serialize.kinds()}


@CALLS.add("GET", f"{_CAMERA}/faults")
def _faults(site: EmulatorSite, call: CallRequest) -> object:
    """Waiting faults, and the last ones that have happened."""
    return serialize.faults_state(_emulator(site, call))


@CALLS.add(
    "POST", f"{_CAMERA}/faults", body=_FAULTS, sample='{"kind": "drop", "on": "ResultContainer"}'
)
def _inject(site: EmulatorSite, call: CallRequest) -> object:
    """Inject a fault, or a list of them: all, or none if one is wrong."""
    _emulator(site, call).inject(*call.body)
    return _faults(site, call)


@CALLS.add("DELETE", f"{_CAMERA}/faults")
def _clear_faults(site: EmulatorSite, call: CallRequest) -> object:
    """Forget waiting faults, and end lasting ones."""
    _emulator(site, call).clear_faults()
    return _faults(site, call)


@CALLS.add("POST", f"{_CAMERA}/commands/{{command}}")
def _command(site: EmulatorSite, call: CallRequest) -> object:
    """Give a command for which cues of the scenario's timeline wait."""
    emulator, name = _emulator(site, call), call.path["command"]
    if name not in emulator.commands:
        known = ", ".join(emulator.commands) or "none: its scenario's timeline has no command"
        raise RefusedError(404, f"no command is called {name!r}", known)
    emulator.command(name)
    return {"camera": _state(site, call)}


@CALLS.add("GET", f"{_CAMERA}/scene")
def _scene(site: EmulatorSite, call: CallRequest) -> object:
    """The table: parts at their true poses, the field of view, and what was reported."""
    return serialize.scene_state(_emulator(site, call), _table(site, call))


@CALLS.add(
    "PUT",
    f"{_CAMERA}/scene/parts/{{part}}",
    body=_PartPose,
    sample='{"x": 0.2, "y": 0.1, "theta": 0.0}',
)
def _put_part(site: EmulatorSite, call: CallRequest) -> object:
    """Add a part to the table, or move it: metres and radians."""
    parts, name = _table(site, call).pieces, call.path["part"]
    if not (name.isascii() and name.isprintable() and len(name) <= 50):
        raise RefusedError(
            422, f"the part {name!r}", "a name of 1 to 50 printable ASCII characters"
        )
    if name not in parts and len(parts) >= MAX_PARTS:
        raise RefusedError(422, f"part {MAX_PARTS + 1}", f"{MAX_PARTS} parts on a table at most")
    body: _PartPose = call.body
    parts[name] = TablePose(body.x, body.y, body.theta)
    return _scene(site, call)


@CALLS.add("DELETE", f"{_CAMERA}/scene/parts/{{part}}")
def _remove_part(site: EmulatorSite, call: CallRequest) -> object:
    """Take a part off the table."""
    parts, name = _table(site, call).pieces, call.path["part"]
    if parts.pop(name, None) is None:
        known = ", ".join(parts) or "nothing: the table is empty"
        raise RefusedError(404, f"no part is called {name!r}", known)
    return _scene(site, call)


@CALLS.add("POST", f"{_CAMERA}/scene/reset")
def _reset_scene(site: EmulatorSite, call: CallRequest) -> object:
    """Put all parts back to their first places."""
    parts = _table(site, call).pieces
    parts.clear()
    parts.update(PIECES)
    return _scene(site, call)


@CALLS.add("GET", f"{_CAMERA}/log", query=_LogQuery)
async def _log(site: EmulatorSite, call: CallRequest) -> object:
    """Log entries from serial `?since=` on, `?limit=` at most; `next` is the serial to go on with.

    With `?wait=` seconds it waits for the first one.
    """
    emulator, query = _emulator(site, call), call.query
    since: int = query.since or 0

    def has_entry() -> bool:
        return bool(emulator.log.since(since, 1)[0])

    if query.wait:
        await site.wait_for(call.request, has_entry, query.wait)
    return serialize.log_part(emulator, since, query.limit)[0]


@CALLS.add("GET", f"{_CAMERA}/log/{{serial}}")
def _log_entry(site: EmulatorSite, call: CallRequest) -> object:
    """One log entry, with all of its payload."""
    emulator, text = _emulator(site, call), call.path["serial"]
    serial = int(text) if text.isdecimal() and len(text) < 20 else -1
    entries, count = emulator.log.since(serial, 1)
    first = count - len(emulator.log)
    if not entries or serial < first:
        entries_text = f"{first} to {count - 1}" if len(emulator.log) else "none"
        raise RefusedError(404, f"log entry {text!r}", f"one that is there: {entries_text}")
    return serialize.camera_entry(serial, entries[0], emulator, whole=True)


@CALLS.add("DELETE", f"{_CAMERA}/log")
def _clear_log(site: EmulatorSite, call: CallRequest) -> object:
    """Empty the log."""
    emulator = _emulator(site, call)
    emulator.log.clear()
    return {"next": serialize.log_count(emulator)}


@CALLS.add(
    "GET",
    f"{_CAMERA}/events",
    about="What happens, as server-sent events: `camera`, `scene`, `faults`, `log`, `clock`; "
    "the log from `?since=` on, else from now.",
    query=_LogStart,
)
def _events(site: EmulatorSite, call: CallRequest) -> object:
    name = _camera_name(site, call)
    since: int | None = call.query.since
    last = call.request.headers.get("Last-Event-ID", "")
    if since is None and last.isdecimal() and len(last) < 20:
        since = int(last)
    watcher = EmulatorWatcher(name, site.cameras[name], since)
    return site.streams.serve(call.request, watcher.find_events)
