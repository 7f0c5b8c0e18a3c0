"""Define the keys of a fleet, and match patterns of keys. ``docs/bus.md`` lists the keys."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

ROOT = "smartcam"

ANYONE = "anyone"
"""The role of a program without a certificate, or with one without a role."""

COMMANDS = frozenset(
    {
        "trigger",
        "switch_application",
        "ensure_application",
        "enter_application",
        "leave_application",
        "start",
        "stop",
        "reset_errors",
        "set_clock",
        "set_input",
        "set_sequence_number",
        "reboot",
        "take_back",
        "request",
        "reserve",
        "release",
        "set_feature",
        "execute_feature",
        "trigger_frame",
    }
)
"""Calls that change something, or reserve the camera; all other calls are questions."""

COMMANDS_WITH_RESERVATION = COMMANDS - {"release", "leave_application"}
"""Commands that carry the number of the reservation in whose block they are called. They fail if
the reservation is lost."""


@lru_cache(maxsize=4096)
def patterns_overlap(one: str, other: str) -> bool:
    """Return True if some key matches both patterns: ``*`` is one chunk, ``**`` any number."""
    return _patterns_overlap(tuple(one.split("/")), tuple(other.split("/")))


def _patterns_overlap(one: Sequence[str], other: Sequence[str]) -> bool:
    """Return True if some key matches both patterns; needs one step for each pair of chunks."""
    # for each prefix of the other pattern: whether it overlaps with the first pattern's prefix
    row: list[bool] = [True]
    for chunk in other:
        row.append(row[-1] and chunk == "**")
    for chunk in one:
        previous_row, row = row, [row[0] and chunk == "**"]
        for index, other_chunk in enumerate(other):
            if "**" in (chunk, other_chunk):
                row.append(previous_row[index + 1] or row[-1])
            else:
                row.append(previous_row[index] and _chunks_overlap(chunk, other_chunk))
    return row[-1]


def _chunks_overlap(one: str, other: str) -> bool:
    return (
        one == other
        or "*" in {one, other}
        or _chunk_matches(one, other)
        or _chunk_matches(other, one)
    )


def _chunk_matches(pattern: str, chunk: str) -> bool:
    """Return True if a chunk matches a pattern in Zenoh's form, such as ``cam$*``."""
    first, *parts = pattern.split("$*")
    if not parts or not chunk.startswith(first):
        return False
    *parts, last = parts
    position = len(first)
    for part in parts:  # match each part as early as possible
        position = chunk.find(part, position)
        if position < 0:
            return False
        position += len(part)
    return len(chunk) - position >= len(last) and chunk.endswith(last)


class Keys:
    """The keys of one fleet.

    Access is granted by prefix, so commands, questions, results, states, presence and the keys for
    other programs each have a prefix of their own.

    Args:
        fleet: name of the fleet.
    """

    def __init__(self, fleet: str) -> None:
        self.fleet = fleet
        self.root: str = f"{ROOT}/{fleet}"

    def agent(self, agent: str) -> str:
        """Return the key under which an agent is present."""
        return f"{self.root}/presence/agent/{agent}"

    def start(self, agent: str, start: str) -> str:
        """Return the key of one start of an agent; two such keys show two agents of one name."""
        return f"{self.root}/presence/start/{agent}/{start}"

    def camera(self, agent: str, camera: str) -> str:
        """Return the key under which a camera is present at its agent, connected or not."""
        return f"{self.root}/presence/camera/{agent}/{camera}"

    def program(self, program: str) -> str:
        """Return the key under which a program is present; ``program``: its name and secret."""
        return f"{self.root}/presence/program/{program}"

    def command(self, agent: str, camera: str) -> str:
        """Return the key of commands to a camera's agent."""
        return f"{self.root}/command/{agent}/{camera}"

    def ask(self, role: str, agent: str, camera: str) -> str:
        """Return the key of a role's questions to a camera's agent, which change nothing."""
        return f"{self.root}/ask/{role}/{agent}/{camera}"

    def reload(self, agent: str) -> str:
        """Return the key of requests to an agent to read its file again."""
        return f"{self.root}/administer/{agent}/reload"

    def reply(self, program: str) -> str:
        """Return the key of replies to a program."""
        return f"{self.root}/reply/{program}"

    def frames(self, program: str) -> str:
        """Return the key of frames' bytes for a program."""
        return f"{self.root}/frames/{program}"

    def states(self, camera: str) -> str:
        """Return the key of a camera's states."""
        return f"{self.root}/states/{camera}"

    def results(self, camera: str) -> str:
        """Return the key of a camera's results."""
        return f"{self.root}/results/{camera}"

    def bundle(self, agent: str) -> str:
        """Return the key of an agent's bundles, which have the results of all its cameras."""
        return f"{self.root}/bundle/{agent}"

    def summary(self, agent: str) -> str:
        """Return the key of questions about all cameras of an agent; in JSON."""
        return f"{self.root}/summary/{agent}"

    def outlets(self, agent: str, name: str) -> str:
        """Return the key of questions about an agent's outlets: counts, results; in JSON."""
        return f"{self.root}/outlets/{agent}/{name}"

    def listing(self, camera: str) -> str:
        """Return the key of questions for a camera's description; in JSON."""
        return f"{self.root}/cameras/{camera}"

    def topic(self, kind: str, camera: str) -> str:
        """Return the key of a camera's ``results``, ``status`` or ``events`` in JSON."""
        return f"{self.root}/topic/{kind}/{camera}"

    def service(self, camera: str, name: str) -> str:
        """Return the key of a service for programs without smartcam."""
        return f"{self.root}/service/{camera}/{name}"

    def thesis(self, name: str) -> str:
        """Return the key of a service of the thesis with which smartcam began."""
        return f"{self.root}/thesis/{name}"

    def thesis_topic(self, name: str) -> str:
        """Return the key of a topic that a request to these services names."""
        return f"{self.root}/thesis/topic/{name}"

    def tail(self, key: str, kind: str) -> list[str]:
        """Return the chunks of ``key`` after ``kind``, such as ``presence/camera``."""
        return key.removeprefix(f"{self.root}/{kind}/").split("/")
