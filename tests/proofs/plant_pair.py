"""Two agents that stand by for each other: who has a camera, as it says itself, and who may."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from tests.proofs.plant_hosts import HUB

if TYPE_CHECKING:
    from tests.proofs.plant_faults import Happening
    from tests.proofs.plant_judge import Storm

Told = dict[int, dict[str, int]]
"""Numbers of losses of each camera of the pair that the program of each host was told."""

PAIR = (1, 2)
"""Hosts of the two agents."""

PAIRED = ("pair/cam1", "pair/cam2")
"""Cameras that both have in their files; on a host of their own."""

ROUTER_AND_MORE = 2
"""Moves of a camera where the router was gone, and one of the pair was longer."""


class Having(NamedTuple):
    """A session with a camera."""

    at: float
    host: int


class Pair:
    """Hears from the cameras whose session they serve.

    Attributes:
        sessions: how many each has had.
    """

    def __init__(self) -> None:
        self.sessions: Counter[str] = Counter()
        self._now: dict[str, int | None] = dict.fromkeys(PAIRED)
        self._turns: dict[str, list[Having]] = {name: [] for name in PAIRED}

    def hear(self, name: str, host: int | None) -> None:
        """A camera has a session with the agent of a host, or none any more."""
        self._now[name] = host
        if host is None:
            return
        self.sessions[name] += 1
        turns = self._turns[name]
        if not turns or turns[-1].host != host:
            turns.append(Having(time.monotonic(), host))

    def holder(self, name: str) -> int | None:
        """Return the host that had it last."""
        turns = self._turns[name]
        return turns[-1].host if turns else None

    def moves(self, name: str, since: float) -> Sequence[int]:
        """Return the hosts to which it went, one after the other."""
        return [host for at, host in self._turns[name] if at >= since]

    def agreed(self, seen: Mapping[str, Sequence[str]]) -> bool:
        """Return True if one agent has each camera, and is ``seen`` there, by camera."""
        return all(
            self._now[name] is not None and [*seen.get(name, ())] == [f"host{self._now[name]}"]
            for name in PAIRED
        )

    def __str__(self) -> str:
        return f"sessions by host: {self._now}"


class PairWatch:
    """Looks what the pair makes of faults that happen together.

    Args:
        pair: the pair.
        storm: what comes of it.
        happening: the faults.
        told: what programs were told before.

    Attributes:
        begun: when they begin.
    """

    def __init__(
        self, pair: Pair, storm: Storm, happening: Sequence[Happening], told: Told
    ) -> None:
        self._pair, self._storm, self._happening = pair, storm, happening
        self._told = {host: dict(counts) for host, counts in told.items()}
        self._holders = {name: pair.holder(name) for name in PAIRED}
        self.begun = time.monotonic()

    def successor(self, camera: str) -> tuple[int, Happening] | None:
        """Return the host whose agent must take a camera over, and for what; None if none must."""
        holder = self._holders[camera]
        (other,) = {*PAIR} - {holder}
        hit = [one for one in self._happening if one.host == holder and one.gone is not None]
        if any(one.fault.network and one.host in {other, HUB} for one in self._happening):
            return None
        return (other, hit[0]) if hit else None

    def has_taken(self, host: int, camera: str) -> bool:
        """Return True if a host's agent has taken a camera over."""
        return host in self._pair.moves(camera, self.begun)

    def most_moves(self, camera: str) -> int:
        """Return how often a camera may go from one agent to the other.

        The one that has it keeps it. With the router gone nobody takes anything over, but where
        another fault keeps one of the two away for longer than the other one waits for it.
        """
        happening = self._happening
        if any(one.host == HUB for one in happening):
            hit = any(one.fault.network and one.host in PAIR for one in happening)
            return ROUTER_AND_MORE if hit else 0
        mine = [one for one in happening if one.host == self._holders[camera]]
        return sum(one.fault.moves for one in mine if one.gone is not None)

    def judge(self, told: Told) -> None:
        """Nobody takes what the other one can keep, nobody flaps, and programs are told of it.

        Args:
            told: what they were told up to now.
        """
        what = ", ".join(map(str, self._happening))
        for camera, holder in self._holders.items():
            moves = self._pair.moves(camera, self.begun)
            for one in self._happening:
                self._storm.moves[one.name] += len(moves)
            went = f"{what}: {camera} went from host {holder} to {[*moves]}"
            most = self.most_moves(camera)
            if len(moves) > most:
                self._storm.complain(f"{went}, which may be {most} times")
            quiet = [
                host for host, counts in told.items() if counts[camera] <= self._told[host][camera]
            ]
            if moves and quiet:
                self._storm.complain(f"{went}, and the programs of hosts {quiet} were not told")
