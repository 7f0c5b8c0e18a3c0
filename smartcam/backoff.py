"""Define the delays between attempts to reach a lost camera again."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator  # noqa: TC003 - pydantic evaluates annotations
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from smartcam._arguments import (
    MAX_SECONDS,
    check_callable,
    check_integer,
    check_number,
    check_seconds,
)
from smartcam.exceptions import (
    CommandRejectedError,
    ConfigurationError,
    LinkError,
    PluginError,
    SmartCamError,
)

if TYPE_CHECKING:
    import random

__all__ = ["Backoff"]

MAX_FACTOR = sys.float_info.max
"""Largest factor between two delays: with it, already the second delay is ``maximum``."""


def is_transient(error: BaseException) -> bool:
    """Return True if another try to reach the camera may succeed after this error.

    Faults of links are transient: nothing listens, no route to the host, a host name that does not
    resolve while the name server is away, silence, a peer that breaks the protocol. Errors in the
    user's options or in a plug-in are not, nor is a camera that refuses the session: a wrong
    password stays wrong, and many tries may lock the account.
    """
    refused = isinstance(error.__cause__, CommandRejectedError)
    if refused or isinstance(error, (ConfigurationError, PluginError)):
        return False
    return isinstance(error, (LinkError, SmartCamError, OSError))


@dataclass(frozen=True, slots=True, kw_only=True)
class Backoff:
    """Delays between tries to reach a lost camera again, which grow up to a maximum.

    Attributes:
        initial: the first delay, seconds. A link that was cut is often back at once.
        factor: ratio of each delay to the one before, until ``maximum``.
        maximum: the longest delay, seconds. A rebooting camera is away for about 30 s.
        jitter: share of each delay that is random, so that many clients do not try at the same
            time: 0 (none) to 1.
        attempts: number of tries before giving up; None for no limit.
        transient: function that returns whether another try may help after an error; otherwise the
            client gives up.

    Raises:
        ConfigurationError: a value cannot work.
    """

    initial: float = 0.1
    factor: float = 2.0
    maximum: float = 10.0
    jitter: float = 0.3
    attempts: int | None = None
    transient: Callable[[BaseException], bool] = field(default=is_transient, repr=False)

    def __post_init__(self) -> None:
        owner = "Backoff"
        initial = check_seconds(self.initial, "initial", owner)
        checked: dict[str, object] = {
            "initial": initial,
            "factor": check_number(self.factor, "factor", 1, MAX_FACTOR, owner),
            "maximum": check_number(
                self.maximum, "maximum", initial, MAX_SECONDS, owner, unit="seconds"
            ),
            "jitter": check_number(self.jitter, "jitter", 0, 1, owner),
            "transient": check_callable(self.transient, "transient", owner),
        }
        if self.attempts is not None:
            checked["attempts"] = check_integer(self.attempts, "attempts", 1, owner=owner)
        for name, value in checked.items():
            object.__setattr__(self, name, value)  # the class is frozen

    def delays(
        self, *, short_lived: int = 0, chance: random.Random | None = None
    ) -> Iterator[float]:
        """Yield the delay before each try, seconds; end after ``attempts``.

        Args:
            short_lived: number of sessions in a row, up to the last one, that were lost soon after
                they began. The first delay is as long as after that many failed tries; otherwise a
                link that always breaks at once would be opened again and again without a pause.
            chance: random source of the jitter; seed it to get the same delays again.
        """
        check_integer(short_lived, "short_lived", 0, owner="Backoff")
        if chance is None:
            from random import Random  # imported late, since it takes longer than this whole module

            chance = Random()  # noqa: S311 - spreads load, keeps no secret
        delay, tried = self.initial, 0
        for _ in range(short_lived):
            delay = min(delay * self.factor, self.maximum)
        while self.attempts is None or tried < self.attempts:
            yield delay * (1.0 - self.jitter * chance.random())
            delay = min(delay * self.factor, self.maximum)
            tried += 1
