"""Reload a fleet file in a running agent; unchanged cameras are not touched.

First the file is read and checked completely, and new emulated cameras are started. If one of these
steps fails, nothing is changed. The changes that follow run in a task of their own, which continues
if the caller is cancelled; their failures are only logged.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import hashlib
import logging
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from smartcam.exceptions import ConfigurationError, ConnectionClosedError, SmartCamError
from smartcam.fleet._file.fleet_file import FleetFile, load_fleet
from smartcam.fleet._file.ros import RosCamera

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.fleet._agent.agent import Agent
    from smartcam.fleet._file.fleet_file import PlannedCamera
    from smartcam.fleet._frames.camera_frames import FrameSupply
    from smartcam.settings import CameraSettings

logger: logging.Logger = logging.getLogger("smartcam.fleet")

REMOVED, CHANGED = "it was removed from the fleet file", "its entry in the fleet file has changed"
"""Reasons why a reload ends the session with a camera, as texts for the camera's programs."""

READ_TIMEOUT = 10.0
"""Seconds for reading a file and the files that it names; they may be on a network drive."""

RELOADABLE_FIELDS = frozenset({"cameras"})
"""Fields of a fleet file that can be changed while the agent runs; other fields need a restart."""


@dataclasses.dataclass(frozen=True, slots=True)
class FleetChanges:
    """The changes of a reloaded fleet file, by the cameras' names.

    Attributes:
        agent: name of the agent that read the file.
        added: new cameras.
        removed: cameras that are no longer shared.
        changed: cameras that were closed and opened again.
        kept: number of unchanged cameras, whose sessions were not touched.
    """

    agent: str
    added: tuple[str, ...]
    removed: tuple[str, ...]
    changed: tuple[str, ...]
    kept: int

    def __str__(self) -> str:
        parts = [
            f"{len(names)} {change} ({_shortened(names)})"
            for change in ("added", "removed", "changed")
            if (names := getattr(self, change))
        ]
        return ", ".join([*parts, f"{self.kept} kept"])


def _shortened(names: tuple[str, ...], max_names: int = 5) -> str:
    more = f" and {len(names) - max_names} more" if len(names) > max_names else ""
    return ", ".join(names[:max_names]) + more


class CameraSource(NamedTuple):
    """The source of a session with a camera.

    Attributes:
        settings: settings of the client that has the session.
        frames: source of the camera's frames; None for none.
        emulator: exit stack that stops the emulated camera; empty for a real camera.
    """

    settings: CameraSettings
    frames: FrameSupply | None
    emulator: contextlib.AsyncExitStack


class LoadedFleet(NamedTuple):
    """A fleet file that was read and checked.

    Attributes:
        file: contents of the fleet file.
        plan: cameras of the file, by name.
        fingerprints: values by the camera's name, which differ if the camera has changed: the
            camera's entry, and digests of the files that the entry names.
    """

    file: FleetFile
    plan: dict[str, PlannedCamera]
    fingerprints: dict[str, object]


def load_cameras(file: FleetFile, folder: Path) -> LoadedFleet:
    """Return a fleet file with its cameras and their fingerprints.

    Raises:
        ValueError: the cameras are not valid.
    """
    plan = {planned.name: planned for planned in file.plan()}
    digests: dict[str, str] = {}

    def digest(named: str | None) -> str | None:
        if named is None:
            return None
        if named not in digests:
            try:
                digests[named] = hashlib.sha256((folder / named).read_bytes()).hexdigest()
            except OSError as exc:
                digests[named] = str(exc)
        return digests[named]

    def fingerprint(planned: PlannedCamera) -> object:
        entry, emulated = planned.entry, planned.entry.emulated
        if emulated is not None:  # another number of emulated cameras changes none of them
            emulated = emulated.model_copy(update={"count": 1})
            entry = entry.model_copy(update={"emulated": emulated})
        files = [entry.ros2.calibration, entry.ros2.hand_eye]
        files.append(None if emulated is None else emulated.scenario)
        files.append(None if entry.frames is None else entry.frames.camera_info)
        files += _files_in(entry.software, folder)
        return entry, planned.index_in_entry, [digest(path) for path in files]

    return LoadedFleet(file, plan, {name: fingerprint(planned) for name, planned in plan.items()})


def _files_in(fields: object, folder: Path) -> list[str | None]:
    """Return the texts in the fields of a software camera that are names of existing files."""
    if isinstance(fields, dict):
        return [path for part in fields.values() for path in _files_in(part, folder)]
    if isinstance(fields, list):
        return [path for part in fields for path in _files_in(part, folder)]
    try:
        return [fields] if isinstance(fields, str) and (folder / fields).is_file() else []
    except (OSError, ValueError):  # not the name of a file
        return []


class Reloader:
    """Reloads the file of a running agent; one reload at a time.

    Args:
        folder: folder of relative paths, if a file's contents are given and not its path.
        start_source: function that starts a camera's source, given its plan and the folder.
        current: the file before the first reload.

    Attributes:
        current: the file as it was read last.
        sources: sources of the cameras' sessions, by name.
        last: changes, or error, of the last reload; None before the first reload.
        outcomes: counts of successful and of refused reloads.
        on_reload: callback for the start of a reload (None) and for its end (changes or error).
    """

    def __init__(
        self,
        folder: Path,
        current: LoadedFleet,
        start_source: Callable[[PlannedCamera, Path], Awaitable[CameraSource]],
    ) -> None:
        self.current: LoadedFleet = current
        self.sources: dict[str, CameraSource] = {}
        self.last: FleetChanges | SmartCamError | None = None
        self.outcomes: dict[str, int] = {"done": 0, "refused": 0}
        self.on_reload: Callable[[FleetChanges | SmartCamError | None], None] = lambda _: None
        self._folder, self._start_source = folder, start_source
        self._reload_lock = asyncio.Lock()
        self._reading: asyncio.Future[tuple[LoadedFleet, FleetChanges]] | None = None
        self._applying: asyncio.Task[None] | None = None
        self._closed = False

    async def close(self) -> None:
        """Wait for the end of a running reload, and refuse further ones. Bounded."""
        self._closed = True
        if self._applying is not None:
            await asyncio.wait({self._applying})

    async def reload(self, agent: Agent, file: str | Path | FleetFile) -> FleetChanges:
        """Apply ``file`` to a running agent, like :meth:`FleetServer.reload`."""
        async with self._reload_lock:
            self.on_reload(None)
            try:
                changes = await self._reload_with_known_errors(agent, file)
            except SmartCamError as exc:
                logger.warning("the fleet file was not taken, all stays as it was: %s", exc)
                self.last = exc
                raise
            except BaseException:
                self.last = ConfigurationError("the reload was cancelled; all stays as it was")
                if self._applying is not None and not self._applying.done():
                    self.last = ConfigurationError(
                        "the caller of the reload was cancelled before its end"
                    )
                raise
            else:
                logger.info("the fleet file was read again: %s", changes)
                self.last = changes
                return changes
            finally:
                succeeded = isinstance(self.last, FleetChanges)
                self.outcomes["done" if succeeded else "refused"] += 1
                self.on_reload(self.last)

    async def _reload_with_known_errors(
        self, agent: Agent, file: str | Path | FleetFile
    ) -> FleetChanges:
        try:
            return await self._reload(agent, file)
        except SmartCamError:
            raise
        except OSError as exc:
            raise ConfigurationError(f"the fleet file cannot be applied: {exc}") from exc
        except Exception as exc:
            logger.exception("! the reload failed")
            raise SmartCamError(f"fleet file: a fault of ours: {exc!r:.200}") from exc

    async def _reload(self, agent: Agent, file: str | Path | FleetFile) -> FleetChanges:
        if self._applying is not None:  # the reload's caller was cancelled
            await asyncio.wait({self._applying})
        folder = self._folder if isinstance(file, FleetFile) else Path(file).parent
        new, changes = await self._read(file, folder, agent.name)
        _refuse_name_clashes(agent, changes)
        async with contextlib.AsyncExitStack() as stack:
            sources: dict[str, CameraSource] = {}
            for name in (*changes.added, *changes.changed):
                sources[name] = source = await self._start_source(new.plan[name], folder)
                stack.push_async_callback(source.emulator.aclose)
                await asyncio.sleep(0)
            if self._closed:
                raise ConnectionClosedError(f"the agent {agent.name} ends; nothing was changed")
            _refuse_name_clashes(agent, changes)  # a program may have added a camera meanwhile
            stack.pop_all()
            self.current = new
            work = self._apply(agent, (*changes.removed, *changes.changed), sources)
            self._applying = asyncio.get_running_loop().create_task(work, name="smartcam.reload")
        await asyncio.shield(self._applying)
        return changes

    async def _read(
        self, file: str | Path | FleetFile, folder: Path, agent: str
    ) -> tuple[LoadedFleet, FleetChanges]:
        """Read and check a file in a thread; return it and its changes."""
        if self._reading is not None:  # the reload's caller was cancelled, or timed out
            _, unfinished = await asyncio.wait({self._reading}, timeout=READ_TIMEOUT)
            if unfinished:
                raise ConfigurationError(
                    f"fleet file {file}: an earlier reading of a fleet file is still running"
                )

        old = self.current

        def read() -> tuple[LoadedFleet, FleetChanges]:
            contents = file if isinstance(file, FleetFile) else load_fleet(file)
            try:
                new = load_cameras(contents, folder)
            except ValueError as exc:
                raise ConfigurationError(f"fleet {contents.fleet}: {exc}") from exc
            return new, changes_of(old, new, agent)

        self._reading = asyncio.get_running_loop().run_in_executor(None, read)
        self._reading.add_done_callback(_retrieve_error)
        try:
            async with asyncio.timeout(READ_TIMEOUT):
                return await asyncio.shield(self._reading)
        except TimeoutError as exc:
            raise ConfigurationError(
                f"fleet file {file}: it could not be read within {READ_TIMEOUT:g} s"
            ) from exc

    async def _apply(
        self, agent: Agent, removed_names: tuple[str, ...], sources: dict[str, CameraSource]
    ) -> None:
        """Remove cameras from the agent first, since added ones may have their addresses."""
        errors = await asyncio.gather(
            *(
                self._remove_camera(agent, name, CHANGED if name in sources else REMOVED)
                for name in removed_names
            ),
            return_exceptions=True,
        )
        for error in errors:
            if error is not None:
                logger.error("! a camera did not close", exc_info=error)
        for name, source in sources.items():
            self.sources[name] = source
            if self._closed:
                continue  # the agent ends, and closes the source
            if name in agent.shared_cameras:
                logger.error("%s ! it is not shared: a program has added one meanwhile", name)
                continue
            try:
                await agent.add_camera(name, source.settings, source.frames)
            except SmartCamError:
                logger.exception("%s ! it is not shared", name)
            await asyncio.sleep(0)

    async def _remove_camera(self, agent: Agent, name: str, reason: str) -> None:
        source = self.sources.pop(name, None)
        try:
            await agent.remove_camera(name, reason)
        finally:
            if source is not None:
                await source.emulator.aclose()


def changes_of(old: LoadedFleet, new: LoadedFleet, agent: str) -> FleetChanges:
    """Return the changes that a new fleet file makes.

    Raises:
        ConfigurationError: a field cannot be changed while the agent runs; the text names it.
    """
    for field in FleetFile.model_fields:
        if field not in RELOADABLE_FIELDS and getattr(old.file, field) != getattr(new.file, field):
            raise ConfigurationError(
                f"{field}: it was changed, which wants a restart of the agent {agent}; only "
                f"{', '.join(sorted(RELOADABLE_FIELDS))} can be changed while it runs"
            )
    for name, planned in new.plan.items():
        if old.file.ros2 is not None and _ros_entry(old.plan.get(name)) != _ros_entry(planned):
            raise ConfigurationError(
                f"cameras.{name}.ros2: it was changed, which wants a restart of the agent {agent}"
            )
    both = [name for name in new.plan if name in old.plan]
    changed = tuple(name for name in both if new.fingerprints[name] != old.fingerprints[name])
    return FleetChanges(
        agent,
        tuple(name for name in new.plan if name not in old.plan),
        tuple(name for name in old.plan if name not in new.plan),
        changed,
        len(both) - len(changed),
    )


def _refuse_name_clashes(agent: Agent, changes: FleetChanges) -> None:
    """Refuse cameras with the name of a camera that a program has added.

    Raises:
        ConfigurationError: a program has added a camera of the same name.
    """
    for name in changes.added:
        if name in agent.shared_cameras:
            raise ConfigurationError(
                f"cameras.{name}: a program has added a camera of this name (Setup): that "
                "program must stop it first"
            )


def _ros_entry(planned: PlannedCamera | None) -> RosCamera:
    """Return a camera's entry for ROS; for None the entry with its defaults."""
    return RosCamera.model_validate({}) if planned is None else planned.entry.ros2


def _retrieve_error(future: asyncio.Future[tuple[LoadedFleet, FleetChanges]]) -> None:
    if not future.cancelled():
        future.exception()  # the caller got the error, unless it was cancelled
