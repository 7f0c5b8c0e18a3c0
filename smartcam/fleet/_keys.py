"""The keys of a fleet, and which pattern means which key. ``docs/bus.md`` lists them."""

from __future__ import annotations

import re
from functools import lru_cache

ROOT = "smartcam"

COMMANDS = frozenset(
    {
        "trigger",
        "switch_application",
        "ensure",
        "enter",
        "leave",
        "start",
        "stop",
        "reset_errors",
        "set_clock",
        "set_input",
        "set_sequence_number",
        "reboot",
        "request",
        "reserve",
        "release",
    }
)
"""Calls that change something, or keep others from doing so; all others are questions."""


@lru_cache(maxsize=4096)
def meets(one: str, other: str) -> bool:
    """Whether two patterns have a key in common: ``*`` is one chunk, ``**`` any number of them."""
    return _meet(tuple(one.split("/")), tuple(other.split("/")))


def _meet(one: tuple[str, ...], other: tuple[str, ...]) -> bool:
    if one[:1] == ("**",):
        return _meet(one[1:], other) or (bool(other) and _meet(one, other[1:]))
    if other[:1] == ("**",):
        return _meet(other, one)
    if not one or not other:
        return one == other
    first, second = one[0], other[0]
    same = first == second or "*" in {first, second} or _fits(first, second) or _fits(second, first)
    return same and _meet(one[1:], other[1:])


def _fits(pattern: str, chunk: str) -> bool:
    """Whether a chunk is one of a pattern such as ``cam$*``, which the engine knows, too."""
    parts = pattern.split("$*")
    return len(parts) > 1 and re.fullmatch(".*".join(map(re.escape, parts)), chunk) is not None


class Keys:
    """The keys of one fleet.

    What is said under which prefix decides who may say it: commands, questions, results, states,
    presence and what other programs use have prefixes of their own.

    Args:
        fleet: its name.
    """

    def __init__(self, fleet: str) -> None:
        self.fleet = fleet
        self.root: str = f"{ROOT}/{fleet}"

    def agent(self, agent: str) -> str:
        """Presence of an agent."""
        return f"{self.root}/presence/agent/{agent}"

    def camera(self, agent: str, camera: str) -> str:
        """Presence of a camera: its agent has it, whether it is connected or not."""
        return f"{self.root}/presence/camera/{agent}/{camera}"

    def program(self, program: str) -> str:
        """Presence of a program that calls."""
        return f"{self.root}/presence/program/{program}"

    def call(self, agent: str, camera: str, *, command: bool) -> str:
        """Calls to a camera's agent: commands, and questions that change nothing."""
        return f"{self.root}/{'command' if command else 'ask'}/{agent}/{camera}"

    def reload(self, agent: str) -> str:
        """Have an agent read its file again."""
        return f"{self.root}/administer/{agent}/reload"

    def reply(self, program: str) -> str:
        """Replies to a program."""
        return f"{self.root}/reply/{program}"

    def frames(self, program: str) -> str:
        """Bytes of frames, to a program that has asked for them."""
        return f"{self.root}/frames/{program}"

    def states(self, camera: str) -> str:
        """What happens to a camera."""
        return f"{self.root}/states/{camera}"

    def results(self, camera: str) -> str:
        """Results of a camera."""
        return f"{self.root}/results/{camera}"

    def bundle(self, agent: str) -> str:
        """Results of all cameras of an agent, together."""
        return f"{self.root}/bundle/{agent}"

    def summary(self, agent: str) -> str:
        """What an agent knows of all its cameras, for who asks; in JSON."""
        return f"{self.root}/summary/{agent}"

    def listing(self, camera: str) -> str:
        """What there is to know of a camera, for who asks; in JSON."""
        return f"{self.root}/cameras/{camera}"

    def topic(self, kind: str, camera: str) -> str:
        """What is said of a camera in JSON: ``results``, ``status`` or ``events``."""
        return f"{self.root}/topic/{kind}/{camera}"

    def service(self, camera: str, name: str) -> str:
        """A service for programs without smartcam."""
        return f"{self.root}/service/{camera}/{name}"

    def thesis(self, name: str) -> str:
        """A service of the thesis' interface."""
        return f"{self.root}/thesis/{name}"

    def thesis_topic(self, name: str) -> str:
        """A topic of somebody's choice."""
        return f"{self.root}/thesis/topic/{name}"

    def tail(self, key: str, kind: str) -> list[str]:
        """Return the chunks of ``key`` behind ``kind``, such as ``presence/camera``."""
        return key.removeprefix(f"{self.root}/{kind}/").split("/")
