"""Quality of service, and its form in rmw_zenoh's tokens.

A token leaves out values that equal a default: ``rmw_zenoh_cpp/src/detail/qos.cpp`` has the
defaults (reliable, volatile, keep last 42, endless durations), ``liveliness_utils.cpp``
(``qos_to_keyexpr``, ``keyexpr_to_qos``) the form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from smartcam.exceptions import ConfigurationError

DEFAULT_DEPTH = 42
"""Number of messages that rmw_zenoh keeps at a depth of 0; a token leaves this number out."""

MAX_QUEUE_DEPTH = 1_000_000

_RELIABLE, _BEST_EFFORT = 1, 2
_TRANSIENT_LOCAL, _VOLATILE = 1, 2
_KEEP_LAST, _KEEP_ALL = 1, 2
_ENDLESS = (9223372036, 854775807)  # RMW_DURATION_INFINITE


@dataclass(frozen=True, slots=True)
class QoS:
    """The quality of service of a topic or a service.

    Attributes:
        reliable: ``False`` for best effort.
        latched: transient local: a later subscriber gets the last ``depth`` messages.
        depth: number of kept messages; None: all, and a reliable publisher waits for room.
        lifespan: seconds after which a message is no longer delivered.

    Raises:
        ConfigurationError: a value is not valid.
    """

    reliable: bool = True
    latched: bool = False
    depth: int | None = 10
    lifespan: float = math.inf

    def __post_init__(self) -> None:
        if self.depth is not None and not 1 <= self.depth <= MAX_QUEUE_DEPTH:
            raise ConfigurationError(
                f"QoS: depth {self.depth}: expected 1 to {MAX_QUEUE_DEPTH}, or None for all"
            )
        if not self.lifespan > 0:
            raise ConfigurationError(f"QoS: lifespan {self.lifespan}: expected seconds above 0")

    @property
    def kept(self) -> int:
        """Number of messages that queues of smartcam keep, also if ``depth`` is None."""
        return DEFAULT_DEPTH if self.depth is None else self.depth

    def encode(self) -> str:
        """Return the quality of service as a part of a token."""
        depth = "" if self.depth in {None, DEFAULT_DEPTH} else str(self.depth)
        lifespan = ","
        if math.isfinite(self.lifespan):
            seconds = int(self.lifespan)
            lifespan = f"{seconds},{round((self.lifespan - seconds) * 1e9)}"
        return ":".join(
            (
                "" if self.reliable else str(_BEST_EFFORT),
                str(_TRANSIENT_LOCAL) if self.latched else "",
                f"{'' if self.depth is not None else _KEEP_ALL},{depth}",
                ",",
                lifespan,
                ",,",
            )
        )

    @classmethod
    def decode(cls, text: str) -> QoS:
        """Read a quality of service from a part of a token.

        Raises:
            ValueError: the text is no quality of service.
        """
        parts = [part.split(",") for part in text.split(":")]
        if [len(part) for part in parts] != [1, 1, 2, 2, 2, 3]:
            raise ValueError(f"quality of service {text!r:.80}: expected six parts, as ::,5:,:,:,,")
        (reliability,), (durability,), (history, depth), _, lifespan, _ = [
            [int(digits) if digits else 0 for digits in part] for part in parts
        ]
        seconds = lifespan[0] + lifespan[1] / 1e9
        endless = not seconds or tuple(lifespan) == _ENDLESS
        return cls(
            reliable=reliability != _BEST_EFFORT,
            latched=durability == _TRANSIENT_LOCAL,
            depth=None if history == _KEEP_ALL else min(depth, MAX_QUEUE_DEPTH) or DEFAULT_DEPTH,
            lifespan=math.inf if endless else seconds,
        )


DEFAULT = QoS()
"""Default quality of ROS 2: reliable, the last ten messages."""

DRIVER = QoS(depth=5)
"""Quality of drivers (REP-2003): reliable, the last five messages; consumers use SENSOR_DATA."""

SENSOR_DATA = QoS(reliable=False, depth=5)
LATCHED = QoS(latched=True, depth=1)
SERVICES = DEFAULT
PARAMETERS = QoS(depth=1000)
