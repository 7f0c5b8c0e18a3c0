"""Serve ``reload`` over the bus: an agent reads its file again, and replies with the changes."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, cast

from smartcam.exceptions import LocalProtocolError, ResponseTimeoutError, SmartCamError
from smartcam.fleet._agent.reload import FleetChanges
from smartcam.fleet._bus.errors import from_fields, to_fields
from smartcam.fleet._json.topics import as_json
from smartcam.models import jsonable

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.fleet._agent.agent import Agent
    from smartcam.fleet._bus.bus import Bus, BusQuestion, Handle
    from smartcam.fleet._bus.keys import Keys

MAX_RUNNING_RELOADS = 16
"""Largest number of running reloads at one agent."""


class ReloadService:
    """Answers programs' requests to reload an agent's fleet file.

    Args:
        agent: the agent, in whose tasks the reloads run.
        bus: the agent's connection to the bus.
        keys: keys of the fleet.
        reload: function that reads the file again and returns the changes.
    """

    def __init__(
        self,
        agent: Agent,
        bus: Bus,
        keys: Keys,
        reload: Callable[[], Awaitable[FleetChanges]],
    ) -> None:
        self._agent, self._reload = agent, reload
        self._running_count = 0
        self._handle: Handle = bus.answer(keys.reload(agent.name), self._on_question)

    def close(self) -> None:
        """Stop answering."""
        self._handle.close()

    def _on_question(self, question: BusQuestion) -> None:
        if self._running_count >= MAX_RUNNING_RELOADS:
            text = (
                f"{self._agent.name}: {self._running_count} reloads are under way; nothing was done"
            )
            self._reply(question, {"error": to_fields(LocalProtocolError(text))})
            return
        self._running_count += 1
        self._agent.start_task(self._answer(question), "smartcam.fleet.reload")

    async def _answer(self, question: BusQuestion) -> None:
        fields: dict[str, Any] = {
            "error": to_fields(SmartCamError("the agent ends; whether it reloaded is unknown"))
        }
        try:
            fields = {"changes": jsonable(await self._reload())}
        except SmartCamError as exc:
            fields = {"error": to_fields(exc)}
        finally:
            self._running_count -= 1
            self._reply(question, fields)

    def _reply(self, question: BusQuestion, fields: dict[str, Any]) -> None:
        question.reply(question.key.replace("*", self._agent.name), as_json(fields))
        question.close()


async def reload_agents(
    bus: Bus, keys: Keys, agents: list[str], timeout: float
) -> dict[str, FleetChanges | SmartCamError]:
    """Make agents reload their files; return the changes or the error of each, by its name."""
    outcomes: dict[str, FleetChanges | SmartCamError] = {}
    pattern = keys.reload(agents[0] if len(agents) == 1 else "*")
    for key, payload in await bus.ask(pattern, b"", timeout):
        agent = key.split("/")[-2]
        outcomes[agent] = _read_answer(agent, payload)
    for agent in agents:
        if agent not in outcomes:
            outcomes[agent] = ResponseTimeoutError(
                f"reload: no answer of the agent {agent} within {timeout:.3g} s: it may be gone "
                "or busy, or this program is not allowed to ask; whether it reloaded is unknown",
                waited=timeout,
            )
    return {name: outcomes[name] for name in sorted(outcomes)}


def _read_answer(agent: str, payload: bytes) -> FleetChanges | SmartCamError:
    try:
        fields = json.loads(payload)
        if "error" in fields:
            return from_fields(fields["error"])
        changes = cast("dict[str, Any]", fields["changes"])
        names = {name: tuple(map(str, changes[name])) for name in ("added", "removed", "changed")}
        return FleetChanges(agent=agent, kept=int(changes["kept"]), **names)
    except (ValueError, KeyError, TypeError, RecursionError) as exc:
        return SmartCamError(f"reload: the agent {agent} sent an unreadable answer: {exc!r:.200}")
