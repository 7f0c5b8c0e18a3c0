"""Replay a recording as a fleet: its cameras under their names, through an agent."""

from __future__ import annotations

import ast
import contextlib
import functools
from typing import TYPE_CHECKING, Any

from smartcam._arguments import check_callable, check_flag, check_iterable, check_text
from smartcam._server import Server
from smartcam.exceptions import ConfigurationError
from smartcam.recording._reader import check_recording
from smartcam.recording._replays.replay import ReplayedCamera, check_speed, replay

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from smartcam.fleet import FleetServer
    from smartcam.frames import FrameSource
    from smartcam.recording._reader import RecordedCamera, Recording
    from smartcam.recording._replays.lines import ReplayedLines


class FleetReplay(Server):
    """Replays the cameras of a recording, each as an emulated one that an agent shares.

    ::

        async with FleetReplay(load_recording("recordings")) as played:
            print(played.server.urls)

    Each camera begins with its session, all of them at about the same time. Triggers get the
    recorded results of triggers; results without a trigger come again at their times. The frames of
    a BVS camera are the recorded pictures of its results, each shown with its result.

    Args:
        recording: recording to replay; usually a folder of a :class:`FleetRecorder`.
        cameras: names of the cameras to replay; default: all.
        speed: factor by which to replay faster than recorded, 0.001 to 1000.
        loop: begin again at the end.
        listen: endpoint of the agent; port 0 chooses a free one.
        on_over: function that is called once for each camera, with its name, at the end of its
            recording.

    Attributes:
        skipped: reason why a camera is not replayed, by its name: it had no session, or there is
            no emulated camera of its maker.

    Raises:
        ConfigurationError: an argument is wrong, or none of the cameras can be replayed.
        MissingExtraError: the extra ``fleet`` is not installed.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        cameras: Iterable[str] | None = None,
        speed: float = 1.0,
        loop: bool = False,
        listen: str = "tcp/127.0.0.1:0",
        on_over: Callable[[str], None] = lambda _: None,
    ) -> None:
        check_recording(recording, "replay")
        if cameras is not None:
            given = check_iterable(cameras, "cameras", "names of cameras", "replay")
            cameras = [check_text(camera, "cameras", "replay") for camera in given]
        speed, loop = check_speed(speed), check_flag(loop, "loop", "replay")
        self._recording, self._listen = recording, check_text(listen, "listen", "replay", least=1)
        self._server: FleetServer | None = None
        self._stack = contextlib.AsyncExitStack()
        self.skipped: dict[str, str] = {}
        self._cameras: dict[str, ReplayedCamera | ReplayedLines] = {}
        self._on_over = check_callable(on_over, "on_over", "replay")
        for name in recording.cameras if cameras is None else cameras:
            try:
                self._cameras[name] = replay(
                    recording,
                    camera=name,
                    speed=speed,
                    loop=loop,
                    on_over=functools.partial(self._on_camera_over, name),
                )
            except ConfigurationError as exc:
                if cameras is not None:
                    raise
                self.skipped[name] = str(exc)
        self._already_over = {
            name for name, camera in self._cameras.items() if not camera.remaining
        }
        if not self._cameras:
            reason = "; ".join(self.skipped.values()) or "no camera is in it"
            raise ConfigurationError(f"recording {recording.path}: nothing can be played: {reason}")

    def _on_camera_over(self, name: str) -> None:
        if name not in self._already_over:
            self._on_over(name)

    @property
    def server(self) -> FleetServer:
        """The server of the agent.

        Raises:
            ConfigurationError: the agent is not started.
        """
        if self._server is None:
            raise ConfigurationError(f"recording {self._recording.path}: the agent is not started")
        return self._server

    async def start(self) -> None:
        """Start the cameras and the agent, which connects to them.

        Raises:
            ConnectFailedError: a port cannot be listened on.

        Cancellation: leaves it stopped.
        """
        from smartcam.fleet import FleetFile, FleetServer

        if self._server is not None:
            return
        async with contextlib.AsyncExitStack() as stack:
            entries: dict[str, Any] = {}
            frames: dict[str, Callable[[], FrameSource]] = {}
            fleet = None
            for name, camera in self._cameras.items():
                await stack.enter_async_context(camera)
                recorded = self._recording.camera(name)
                fleet = fleet or recorded.metadata.get("fleet")
                entries[name] = {"url": camera.url, **_camera_options(recorded)}
                if isinstance(camera, ReplayedCamera):
                    pictures = camera._prepare_pictures(self._recording, name)  # noqa: SLF001
                    if pictures is not None:
                        frames[name] = pictures.source
            content: dict[str, Any] = {"listen": self._listen, "cameras": entries}
            if fleet is not None:
                content["fleet"] = fleet
            try:
                file = FleetFile.model_validate(content)
            except ValueError as exc:
                raise ConfigurationError(f"recording {self._recording.path}: {exc}") from exc
            server = await stack.enter_async_context(FleetServer(file, _frames=frames))
            self._server, self._stack = server, stack.pop_all()

    async def stop(self) -> None:
        """Stop the agent and the cameras. A second call does nothing."""
        self._server = None
        await self._stack.aclose()


def _camera_options(camera: RecordedCamera) -> dict[str, Any]:
    """Return a camera's settings for the agent, without the address."""
    options: dict[str, Any] = {}
    spec = camera.interpret_as
    if spec is not None:
        options["interpret_as"] = spec
        if spec.startswith("{"):
            with contextlib.suppress(ValueError, SyntaxError, MemoryError, RecursionError):
                options["interpret_as"] = ast.literal_eval(spec)
    for name in ("y_down", "lenient"):
        if camera.metadata.get(name) == "True":
            options[name] = True
    return options
