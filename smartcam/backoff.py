"""The delays between attempts to reach a lost camera again, as a value."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator  # noqa: TC003 - old pydantic looks them up
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
"""Largest factor between two delays: the longest delay follows the first at once."""


def is_transient(error: BaseException) -> bool:
    """Return True if another try may succeed.

    What happens to links does pass: nothing listens, no way to the host, a name that does not
    resolve while the name server is away, silence, a peer that breaks the protocol. An error in
    what the user gave or in a plug-in does not, nor a camera that refuses the session: a wrong
    password stays wrong, and many tries may lock the account.
    """
    refused = isinstance(error.__cause__, CommandRejectedError)
    if refused or isinstance(error, (ConfigurationError, PluginError)):
        return False
    return isinstance(error, (LinkError, SmartCamError, OSError))


@dataclass(frozen=True, slots=True, kw_only=True)
class Backoff:
    """Delays between tries to reach a camera again, which grow up to a maximum.

    Attributes:
        initial: the first delay, seconds. A link that was cut is often back at once.
        factor: how much longer each delay is than the one before, until ``maximum``.
        maximum: the longest delay, seconds. A rebooting camera is away for about 30 s.
        jitter: share of each delay that is left to chance, so that many clients do not come all at
            the same instant: 0 (none) to 1.
        attempts: tries until it is given up; None for never.
        transient: says of an error whether trying again may help; where not, it is given up.

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
        who = "Backoff"
        initial = check_seconds(self.initial, "initial", who)
        checked: dict[str, object] = {
            "initial": initial,
            "factor": check_number(self.factor, "factor", 1, MAX_FACTOR, who),
            "maximum": check_number(
                self.maximum, "maximum", initial, MAX_SECONDS, who, unit="seconds"
            ),
            "jitter": check_number(self.jitter, "jitter", 0, 1, who),
            "transient": check_callable(self.transient, "transient", who),
        }
        if self.attempts is not None:
            checked["attempts"] = check_integer(self.attempts, "attempts", 1, who=who)
        for name, value in checked.items():
            object.__setattr__(self, name, value)  # the plain value, of a class that is frozen

    def delays(
        self, *, short_lived: int = 0, chance: random.Random | None = None
    ) -> Iterator[float]:
        """Give the delay before each try, seconds; ends after ``attempts``.

        Args:
            short_lived: sessions in a row that were lost soon: the delays begin so many steps
                later, or a link that breaks as soon as it is made would be made without a pause.
            chance: where the jitter comes from; seed it for the same delays again.
        """
        check_integer(short_lived, "short_lived", 0, who="Backoff")
        if chance is None:
            from random import Random  # which takes longer than all of this module

            chance = Random()  # noqa: S311 - spreads load, keeps no secret
        delay, tried = self.initial, 0
        for _ in range(short_lived):
            delay = min(delay * self.factor, self.maximum)
        while self.attempts is None or tried < self.attempts:
            yield delay * (1.0 - self.jitter * chance.random())
            delay = min(delay * self.factor, self.maximum)
            tried += 1
