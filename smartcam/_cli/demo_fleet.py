"""``smartcam demo --fleet``: agents, cameras and programs in separate processes, step by step."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import smartcam
from smartcam._cli.demo import TANGRAM_ID, Steps
from smartcam._cli.texts import table_text
from smartcam.exceptions import ConnectionLostError, SmartCamError

if TYPE_CHECKING:
    from asyncio.subprocess import Process
    from collections.abc import AsyncGenerator

    from smartcam._cli.options import Options
    from smartcam.fleet import Fleet, FleetCamera
    from smartcam.models import Result

SHARED = "line1/cam1"
CAMERAS_OF_AGENT = {"north": ("line1", 6), "south": ("line2", 4)}
"""Line of the cameras and their number, for each agent."""

ROBOT_TRIGGERS, HAND_TRIGGERS = 9, 3
"""Number of triggers of the robot, and of the dashboard at the same time."""

STEP_TIMEOUT = 30.0
"""Longest time for any step, seconds."""

RESERVED_TIMEOUT = 0.3
"""Seconds that the dashboard waits for a camera that another program has reserved."""


async def demo(options: Options) -> None:
    """Start agents, share a camera, reserve it, trigger all, end agents."""
    from smartcam._zenoh import BusLink, with_ports
    from smartcam.fleet import open
    from smartcam.fleet._inside import ZenohConnection

    ZenohConnection(BusLink())  # raises if the engine is missing
    steps = Steps(options)
    (endpoint,) = with_ports(["tcp/127.0.0.1:0"])
    url = f"fleet://{endpoint.partition('/')[2]}"
    async with contextlib.AsyncExitStack() as stack, asyncio.timeout(4 * STEP_TIMEOUT):
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        agents: dict[str, Process] = {}
        for name, link_kind in (("north", "listen"), ("south", "connect")):
            line, count = CAMERAS_OF_AGENT[name]
            cameras = {f"{line}/**": {"emulated": {"count": count}, "application": TANGRAM_ID}}
            file = Path(folder) / f"{name}.yaml"
            # JSON is YAML, too
            file.write_text(json.dumps({"agent": name, link_kind: endpoint, "cameras": cameras}))
            agents[name] = await stack.enter_async_context(_run_agent(file, count))
            role_text = "is the router, too" if link_kind == "listen" else "joins it there"
            steps.step(
                f"Agent {name}, process {agents[name].pid}, has {count} emulated cameras and "
                f"{role_text}: {url}",
                agent=name,
                url=url,
            )
        fleet = await stack.enter_async_context(open(url))
        _show_fleet(fleet, steps)
        programs = [
            await stack.enter_async_context(smartcam.connect(f"{url}/{SHARED}", name=name))
            for name in ("robot", "dashboard", "recorder")
        ]
        robot, dashboard, recorder = programs
        await _show_sharing(robot, dashboard, recorder, steps)
        await _show_reservation(fleet[SHARED], dashboard, steps)
        await _trigger_all(fleet, steps)
        await _kill_agent(fleet, agents["south"], robot, steps)
        await _end_agent(agents["north"], robot, steps)


@contextlib.asynccontextmanager
async def _run_agent(file: Path, cameras: int) -> AsyncGenerator[Process]:
    """Run an agent in a process of its own; the block begins when its cameras are ready."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "smartcam", "serve", str(file), "--json"),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
    )
    try:
        for _ in range(cameras):
            async with asyncio.timeout(STEP_TIMEOUT):
                line = await process.stdout.readline() if process.stdout is not None else b""
            if not line:
                raise ConnectionLostError(f"the agent of {file.name} did not start")
        yield process
    finally:
        if process.returncode is None:
            with contextlib.suppress(ProcessLookupError):
                process.terminate()
        try:
            async with asyncio.timeout(STEP_TIMEOUT):
                await process.wait()
        except TimeoutError:
            process.kill()
            await process.wait()


def _show_fleet(fleet: Fleet, steps: Steps) -> None:
    cameras = fleet.cameras()
    steps.step(f"The whole fleet by one URL, {len(cameras)} cameras:", agents=fleet.agents())
    rows = [
        (camera.name, *fleet.agents(camera.name), camera.active_application, str(camera.status))
        for camera in cameras
    ]
    steps.detail(
        table_text(("camera", "agent", "application", "status"), rows),
        cameras=[camera.url for camera in cameras],
    )


async def _show_sharing(
    robot: smartcam.Camera, dashboard: smartcam.Camera, recorder: smartcam.Camera, steps: Steps
) -> None:
    steps.step(
        f"Three programs use {SHARED}, each with a connection of its own: a robot triggers, a "
        "dashboard watches and triggers by hand, a recorder takes every result:"
    )
    statuses, recorded = dashboard.statuses(), recorder.results()

    async def trigger(camera: smartcam.Camera, times: int) -> list[int]:
        return [(await camera.trigger(timeout=STEP_TIMEOUT)).number for _ in range(times)]

    async def record() -> list[int]:
        return [(await anext(recorded)).number for _ in range(ROBOT_TRIGGERS + HAND_TRIGGERS)]

    async with asyncio.timeout(STEP_TIMEOUT), asyncio.TaskGroup() as group:
        recorder_task = group.create_task(record())
        robot_task = group.create_task(trigger(robot, ROBOT_TRIGGERS))
        dashboard_task = group.create_task(trigger(dashboard, HAND_TRIGGERS))
    tasks = {"robot": robot_task, "dashboard": dashboard_task, "recorder": recorder_task}
    for name, task in tasks.items():
        numbers = task.result()
        steps.detail(
            f"   {name:9} results {', '.join(map(str, numbers))}", program=name, numbers=numbers
        )
    owned = sorted([*robot_task.result(), *dashboard_task.result()])
    is_right = owned == recorder_task.result()
    verdict = f"{'each' if is_right else 'NOT each'} trigger got its own"
    counts, status_count = recorded.statistics(), statuses.statistics().offered
    steps.detail(f"   {len(owned)} triggers, {len(set(owned))} results: {verdict}", own=owned)
    steps.detail(
        f"   the recorder's counts: sent {counts.offered + counts.missed} = taken "
        f"{counts.taken} + dropped {counts.dropped} + queued {counts.queued} + missed "
        f"{counts.missed}; the dashboard saw {status_count} statuses",
        counts=counts,
        statuses=status_count,
    )


async def _show_reservation(camera: FleetCamera[Any], other: smartcam.Camera, steps: Steps) -> None:
    steps.step(
        f"One program has {SHARED} for itself; the dashboard's trigger waits, and says for whom:"
    )
    async with camera.reserve(STEP_TIMEOUT):
        try:
            await other.trigger(timeout=RESERVED_TIMEOUT)
        except SmartCamError as exc:
            steps.detail(f"   {exc}", error=type(exc).__name__, reason=str(exc))
    result = await other.trigger(timeout=STEP_TIMEOUT)
    steps.detail(f"   and when it is given back: result {result.number}", number=result.number)


async def _trigger_all(fleet: Fleet, steps: Steps) -> None:
    loop = asyncio.get_running_loop()
    started_at = loop.time()
    outcomes = await fleet.trigger(timeout=STEP_TIMEOUT)
    duration = loop.time() - started_at
    results: list[Result] = [
        outcome for outcome in outcomes.values() if not isinstance(outcome, SmartCamError)
    ]
    steps.step(
        f"All cameras triggered at once: {len(results)} results of {len(outcomes)} cameras after "
        f"{1e3 * duration:.0f} ms, each inspection about {1e3 * (results[0].latency or 0):.0f} ms",
        results=len(results),
        cameras=len(outcomes),
    )


async def _kill_agent(fleet: Fleet, agent: Process, robot: smartcam.Camera, steps: Steps) -> None:
    steps.step("Agent south is killed. Every program learns of it at once:")
    events, loop = fleet.events(), asyncio.get_running_loop()
    await _drain(events)
    started_at = loop.time()
    agent.kill()
    _, camera_count = CAMERAS_OF_AGENT["south"]
    event_names: list[str] = []
    async with asyncio.timeout(STEP_TIMEOUT):
        while "AgentLeft" not in event_names or event_names.count("CameraLeft") < camera_count:
            event_names.append(type(await anext(events)).__name__)
    lost_count = event_names.count("CameraLeft")
    steps.detail(
        f"   {1e3 * (loop.time() - started_at):.0f} ms later: {lost_count} cameras and their agent "
        f"are gone; there are {len(fleet)}, of {', '.join(fleet.agents())}",
        gone=lost_count,
        left=len(fleet),
    )
    result = await robot.trigger(timeout=STEP_TIMEOUT)
    steps.detail(f"   the robot goes on: result {result.number}", number=result.number)


async def _drain(events: Any) -> None:
    """Read the waiting events, which report the agents and cameras that already exist."""
    while events.statistics().queued:
        await anext(events)


async def _end_agent(agent: Process, robot: smartcam.Camera, steps: Steps) -> None:
    events = robot.events()
    agent.terminate()
    async with asyncio.timeout(STEP_TIMEOUT):
        while not isinstance(await anext(events), smartcam.Disconnected):
            pass
        await agent.wait()
    try:
        await robot.trigger()
    except SmartCamError as exc:
        steps.step(
            f"Agent north ends; its cameras get their Disconnect. The robot's next trigger: {exc}",
            error=type(exc).__name__,
        )
