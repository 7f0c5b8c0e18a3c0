"""Answer questions about the state of all cameras of an agent, without asking the cameras."""

from __future__ import annotations

import asyncio
import json
import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.exceptions import SmartCamError
from smartcam.fleet._bus.bus import always
from smartcam.fleet._bus.keys import patterns_overlap
from smartcam.fleet._json.topics import as_json
from smartcam.fleet._program.program_name import in_words
from smartcam.models import Status

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from smartcam.fleet._agent.agent import Agent
    from smartcam.fleet._agent.shared_camera import SharedCamera
    from smartcam.fleet._bus.bus import Bus, BusQuestion, Handle
    from smartcam.fleet._bus.keys import Keys

logger: logging.Logger = logging.getLogger("smartcam.fleet")

CAMERAS_PER_TURN = 50
"""Largest number of cameras in one part of an answer, which takes one turn of the event loop."""

MAX_PATTERN_BYTES = 4096
"""Largest number of bytes of a question that are read."""


@dataclass(frozen=True, slots=True)
class CameraSummary:
    """A camera's state, as known to its agent.

    Attributes:
        camera: name of the camera.
        agent: name of the agent that shares the camera.
        connected: whether the agent has a session with it.
        status: last status from the camera; None before the first.
        application: active application; None if it is not known.
        reserved_by: the program that has reserved the camera, in words; None without one.
        reason: reason why there is no session; None if there is one.
    """

    camera: str
    agent: str
    connected: bool
    status: Status | None
    application: int | None
    reserved_by: str | None
    reason: str | None


class ReportedCamera(NamedTuple):
    """One camera in an answer.

    Attributes:
        summary: the camera's state.
        epoch: number of the agent's start.
        next_result: number of the camera's next result.
        standby: whether the agent is a standby agent.
    """

    summary: CameraSummary
    epoch: int
    next_result: int
    standby: bool


class Summaries:
    """Answers for all cameras of an agent.

    Args:
        agent: the agent.
        keys: keys of the fleet.
        bus: the agent's connection to the bus.
    """

    def __init__(self, agent: Agent, keys: Keys, bus: Bus) -> None:
        self._agent, self._keys, self._bus = agent, keys, bus
        self._handle: Handle | None = None

    def open(self) -> None:
        """Start to answer."""
        key = self._keys.summary(self._agent.name)
        self._handle = self._bus.answer(key, self._on_question, low_priority=always)

    def close(self) -> None:
        """Stop answering."""
        if self._handle is not None:
            self._handle.close()

    def _on_question(self, question: BusQuestion) -> None:
        pattern = str(question.payload[:MAX_PATTERN_BYTES], "utf-8", "replace") or "**"
        self._agent.start_task(self._answer(question, pattern), "smartcam.fleet.summary")

    async def _answer(self, question: BusQuestion, pattern: str) -> None:
        """Answer in parts, so that a thousand cameras do not block the event loop."""
        key = self._keys.summary(self._agent.name)
        try:
            chosen = [
                camera
                for camera in self._agent.shared_cameras.values()
                if patterns_overlap(pattern, camera.name)
            ]
            for begin in range(0, len(chosen), CAMERAS_PER_TURN):
                cameras = [*map(_summary_row, chosen[begin : begin + CAMERAS_PER_TURN])]
                summary = {
                    "agent": self._agent.name,
                    "standby": self._agent.is_standby,
                    "cameras": cameras,
                }
                question.reply(key, as_json(summary))
                await asyncio.sleep(0)
        finally:
            question.close()


def _summary_row(camera: SharedCamera) -> list[Any]:
    connected, status, application, reason = camera.session_state()
    return [
        camera.name,
        int(connected),
        status,
        application,
        None if camera.gate.holder is None else in_words(camera.gate.holder),
        reason,
        camera.epoch,
        camera.results.next_number,
    ]


async def ask_cameras(
    bus: Bus, keys: Keys, agent: str, pattern: str, timeout: float
) -> list[ReportedCamera]:
    """Ask agents for their cameras; return the answers that come within ``timeout`` seconds.

    Args:
        bus: a connection to the bus.
        keys: keys of the fleet.
        agent: name of the agent to ask; ``*`` for all agents.
        pattern: pattern of the cameras' names.
        timeout: seconds to wait for the answers.
    """
    answers = await bus.ask(keys.summary(agent), pattern.encode(), timeout)
    cameras: list[ReportedCamera] = []
    for _, payload in answers:
        try:
            cameras += _read_cameras(payload)
        except (ValueError, TypeError, KeyError, SmartCamError) as exc:
            logger.warning("%s ! an agent's cameras cannot be read: %s", keys.fleet, exc)
        await asyncio.sleep(0)
    return cameras


def _read_cameras(payload: bytes) -> Iterable[ReportedCamera]:
    listed: Any = json.loads(payload)
    agent, standby = str(listed["agent"]), bool(listed.get("standby"))
    cameras: list[ReportedCamera] = []
    for name, connected, status, application, holder, reason, epoch, following in listed["cameras"]:
        bits = None if status is None else Status(status)
        summary = CameraSummary(name, agent, bool(connected), bits, application, holder, reason)
        cameras.append(ReportedCamera(summary, int(epoch), int(following), standby))
    return cameras


def best_by_name(
    cameras: Iterable[ReportedCamera], sort_key: Callable[[ReportedCamera], Any]
) -> dict[str, Any]:
    """Return one reported camera for each name: of its agents, that with the highest sort key."""
    reported: dict[str, ReportedCamera] = {}
    for camera in cameras:
        known = reported.get(camera.summary.camera)
        if known is None or sort_key(camera) > sort_key(known):
            reported[camera.summary.camera] = camera
    return reported
