"""The keys of a fleet, and which pattern means which key. ``docs/bus.md`` lists them."""

from __future__ import annotations

from functools import lru_cache

ROOT = "smartcam"


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
    return (first == second or "*" in {first, second}) and _meet(one[1:], other[1:])


class Keys:
    """The keys of one fleet.

    Args:
        fleet: its name.
    """

    def __init__(self, fleet: str) -> None:
        self.fleet = fleet
        self._root = f"{ROOT}/{fleet}"

    def agent(self, agent: str) -> str:
        """Presence of an agent."""
        return f"{self._root}/presence/agent/{agent}"

    def camera(self, agent: str, camera: str) -> str:
        """Presence of a camera: its agent has it, whether it is connected or not."""
        return f"{self._root}/presence/camera/{agent}/{camera}"

    def program(self, program: str) -> str:
        """Presence of a program that calls."""
        return f"{self._root}/presence/program/{program}"

    def call(self, camera: str) -> str:
        """Calls to a camera's agent."""
        return f"{self._root}/call/{camera}"

    def reply(self, program: str) -> str:
        """Replies to a program."""
        return f"{self._root}/reply/{program}"

    def states(self, camera: str) -> str:
        """What happens to a camera."""
        return f"{self._root}/states/{camera}"

    def results(self, camera: str) -> str:
        """Results of a camera."""
        return f"{self._root}/results/{camera}"

    def tail(self, key: str, kind: str) -> list[str]:
        """Return the chunks of ``key`` behind ``kind``, such as ``presence/camera``."""
        return key.removeprefix(f"{self._root}/{kind}/").split("/")
