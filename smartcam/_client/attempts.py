"""Record attempts at a session; find the probable cause of their failure, and a cure."""

from __future__ import annotations

import errno
import os
import re
import socket
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from smartcam._arguments import duration_text
from smartcam.exceptions import (
    CommandRejectedError,
    ConnectionLostError,
    ProtocolError,
    RemoteProtocolError,
    SmartCamError,
)
from smartcam.protocols import Transport

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from smartcam.protocols import Protocol
    from smartcam.settings import Address

OPENING = "opening the link"
CONNECTING = "waiting for the answer to Connect"

_ERRNO = re.compile(r"\[Errno (-?\d+)\]")


class SessionRefusedError(RemoteProtocolError):
    """The answer to Connect is a refusal, if the camera speaks the expected dialect."""


@dataclass(slots=True)
class Attempt:
    """One attempt, and the step that it reached.

    Attributes:
        dialect: name of the dialect; until the camera's dialect is known, the names of all
            dialects that it tries.
        transport: ``tcp`` or ``udp``.
        step: name of the last step that was begun.
        outcome: text that says how the attempt ended.
        received: number of bytes received.
        hung_up: True if the other side ended the link without a byte.
        error: reason why there is no session, None if there is one.
        on_step: function that is called with each new step.
    """

    dialect: str
    transport: str
    step: str = OPENING
    outcome: str = ""
    received: int = 0
    hung_up: bool = False
    error: Exception | None = None
    on_step: Callable[[str], None] | None = None

    @property
    def opened(self) -> bool:
        """True if the link was opened."""
        return self.step != OPENING

    def reach(self, step: str) -> None:
        """Record that a step begins, and call ``on_step``."""
        self.step = step
        if self.on_step is not None:
            self.on_step(step)

    def end(self, error: Exception, waited: float) -> None:
        """Record the error that ended it; a ``UnicodeError`` means an invalid host name."""
        self.error = error
        timeout = isinstance(error, TimeoutError)
        self.hung_up = self.step == CONNECTING and not timeout and not self.received
        lost = error.__cause__ if isinstance(error, ConnectionLostError) else None
        system = lost if isinstance(lost, OSError) else error
        if timeout and not isinstance(error, SmartCamError):
            received_text = f"{self.received} bytes, then silence" if self.received else "silence"
            self.outcome = f"{received_text} for {duration_text(waited, coarse=True)}"
        elif isinstance(system, OSError) and system.errno is not None and system.errno > 0:
            words = os.strerror(system.errno)  # plainer than "Connect call failed"
            # on Windows strerror() does not know the numbers of Winsock
            self.outcome = str(system) if words.startswith("Unknown error") else words
        elif isinstance(error, socket.gaierror) and error.strerror:
            self.outcome = error.strerror
        else:
            self.outcome = str(error)

    def failed_with(self, *numbers: int) -> bool:
        """Return True if one of these system errors is the cause, at any address of the host."""
        error = self.error
        if error is not None and isinstance(error.__cause__, OSError):
            error = error.__cause__
        if not isinstance(error, OSError):
            return False
        errnos = {error.errno} if error.errno else {int(n) for n in _ERRNO.findall(str(error))}
        return not errnos.isdisjoint(numbers)

    def __str__(self) -> str:
        """One line for an error text."""
        return f"{self.dialect} over {self.transport.upper()}: {self.step}: {self.outcome}"


class Reason(NamedTuple):
    """A possible reason for a missing session; :func:`reason_values` fills in its texts."""

    # function that returns, by an attempt's observations, whether this is the cause
    fits: Callable[[Attempt], bool]
    text: str  # text of the problem
    cure: str  # text of the cure


_UNREACHABLE = (errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN, errno.ENETDOWN)

REASONS: tuple[Reason, ...] = (
    Reason(
        lambda attempt: isinstance(attempt.error, (socket.gaierror, UnicodeError)),
        "the name {host!r} does not resolve: {outcome}",
        "Look for a slip in the name, or give the camera's IP address. Names need a DNS server, or "
        "an entry in this machine's hosts file.",
    ),
    Reason(
        lambda attempt: isinstance(attempt.error, (CommandRejectedError, SessionRefusedError)),
        "{where} refuses: {outcome}",
        "Address and dialect are right. Check the password, and whether another client is "
        "connected.",
    ),
    Reason(
        lambda attempt: attempt.failed_with(errno.ECONNREFUSED),
        "nothing listens at {where}: {outcome}",
        "Look at the port ({default} by default), and whether the camera's process interface is "
        "switched on{interface}. A camera that has just been switched on needs about half a "
        "minute.",
    ),
    Reason(
        lambda attempt: attempt.failed_with(*_UNREACHABLE),
        "{where} cannot be reached: {outcome}",
        "Look at the address, at this machine's network and mask, the cable and the camera's "
        "power: both must be in one network, or have a route.",
    ),
    Reason(
        lambda attempt: not attempt.opened and isinstance(attempt.error, TimeoutError),
        "nobody answers at {where}, not even with a refusal: {outcome}",
        "Wrong address, no power, another network, or a firewall that drops what comes. Does the "
        "camera answer a ping from this machine?",
    ),
    Reason(
        lambda attempt: not attempt.opened,
        "no connection to {where}: {outcome}",
        "Look at the address, this machine's network and the camera's.",
    ),
    Reason(
        lambda attempt: attempt.hung_up,
        "{where} takes the connection and hangs up without a word: {outcome}",
        "It may serve another client and refuse newcomers: end the other one. Or it is no "
        "camera, or something else listens at this port.",
    ),
    Reason(
        lambda attempt: isinstance(attempt.error, ProtocolError),
        "what {where} answers is no camera's language: {outcome}",
        "Something else listens there, or a camera with a dialect that smartcam does not know. "
        "smartcam probe shows every byte.",
    ),
    Reason(
        lambda attempt: attempt.received > 0,
        "{where} answers, and no session comes of it: {step}: {outcome}",
        "Something else listens there, or the camera's answers get lost. smartcam probe shows "
        "every byte.",
    ),
    Reason(
        lambda attempt: attempt.transport == Transport.UDP.value,
        "nothing comes back from {where}: {outcome}; UDP does not tell whether anybody is there",
        "Check address, cable and power, whether the camera's process interface is at {port} "
        "({default} by default){interface}, and whether it has another client or dialect.",
    ),
    Reason(
        lambda attempt: True,
        "{where} takes the connection and says nothing: {step}: {outcome}",
        "Check whether the camera's process interface is at {port} ({default} by default)"
        "{interface}, and whether it has another client or dialect.",
    ),
)
"""Causes in order: the first that fits any attempt counts. Causes with received bytes come before
silence."""


def reason_for(attempts: Sequence[Attempt]) -> tuple[Reason, Attempt]:
    """Return the reason why attempts failed, and the attempt that shows it."""
    return next(
        (reason, attempt) for reason in REASONS for attempt in attempts if reason.fits(attempt)
    )


def reason_values(attempt: Attempt, address: Address, protocol: Protocol) -> dict[str, str]:
    """Return the values for the placeholders in a reason's texts."""
    names = [transport.value for transport in protocol.schemes.values()]
    this, others = attempt.transport.upper(), [name for name in names if name != attempt.transport]
    return {
        "where": f"{address.host}:{address.port} ({this})",
        "host": address.host,
        "outcome": attempt.outcome,
        "step": attempt.step,
        "port": str(address.port),
        "default": str(protocol.default_port),
        "interface": f" and set to {this}, not to {others[0].upper()}" if others else "",
    }


def explain(attempts: Sequence[Attempt], address: Address, protocol: Protocol) -> str:
    """Return one cause and one cure for attempts that failed."""
    reason, attempt = reason_for(attempts)
    return f"{reason.text}. {reason.cure}".format(**reason_values(attempt, address, protocol))
