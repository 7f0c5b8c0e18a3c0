"""Keep the link of the present session, and the features of the session's protocol."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING

from smartcam._arguments import check_seconds
from smartcam.exceptions import ConnectionClosedError
from smartcam.protocols import Transport
from smartcam.protocols import messages as m

if TYPE_CHECKING:
    from smartcam._client.link import Link
    from smartcam._client.waits import Waits
    from smartcam.protocols import Dialect

MAX_KNOWN_FEATURES = 64
"""Largest number of dialects whose features are cached. There are some twenty, but a dialect with a
layout is made for each camera."""


@dataclass(frozen=True, slots=True)
class Features:
    """The features of a session's protocol that matter in every trigger.

    Attributes:
        keeps_order: messages arrive in order and none is lost (TCP).
        numbered: the sequence number of a trigger can be set.
        acknowledged: the camera answers a trigger.
        polled: the camera sends the status only on request.
        sends_queries: a Query is sent with each trigger; the messages around its answer show
            whether the camera accepted the trigger.
        shows_triggers: the status shows each accepted trigger.
        ends_triggers: if no result comes, the client ends the trigger shortly before its deadline.
        statuses_suffice: every change of the status is sent, in order, and nothing else shows the
            outcome of a trigger.
    """

    keeps_order: bool = True
    numbered: bool = False
    acknowledged: bool = False
    polled: bool = False
    sends_queries: bool = False
    shows_triggers: bool = True
    ends_triggers: bool = False
    statuses_suffice: bool = False

    @staticmethod
    def of(link: Link) -> Features:
        """Return the features of a link's session; they are cached for each dialect."""
        dialect, keeps_order = link.machine.dialect, link.machine.transport is Transport.TCP
        known = _known_features.get((id(dialect), keeps_order))
        if known is not None:
            return known[1]
        features = Features._of(dialect, keeps_order=keeps_order)
        if len(_known_features) < MAX_KNOWN_FEATURES:
            _known_features[id(dialect), keeps_order] = dialect, features
        return features

    @staticmethod
    def _of(dialect: Dialect, *, keeps_order: bool) -> Features:
        polled = not dialect.capabilities.unasked_status
        acknowledged = dialect.has(m.TriggerAnswer)
        ends = dialect.has(m.EndTrigger)
        # a camera that answers in order needs no Query: the trigger's answer is enough
        sends_queries = keeps_order and not dialect.results_are_attributable
        statuses_suffice = (
            sends_queries and dialect.shows_triggers and not (polled or acknowledged or ends)
        )
        return Features(
            keeps_order=keeps_order,
            numbered=dialect.has(m.SetSequenceNumber),
            acknowledged=acknowledged,
            polled=polled,
            sends_queries=sends_queries,
            shows_triggers=dialect.shows_triggers,
            ends_triggers=ends,
            statuses_suffice=statuses_suffice,
        )


NO_FEATURES = Features()
"""The features before the first session."""

_known_features: dict[tuple[int, bool], tuple[Dialect, Features]] = {}
"""Features, with their dialect, by the id of the dialect and whether messages come in order."""


@dataclass(eq=False)
class Connection:
    """The current link; a new one replaces it in each session.

    Attributes:
        name: the camera's name.
        link: the last link, None before the first.
        features: features of its protocol.
    """

    name: str
    _waits: Waits

    def __post_init__(self) -> None:
        self.link: Link | None = None
        self.features: Features = NO_FEATURES
        self._loop: asyncio.AbstractEventLoop | None = None

    def begin_session(self, link: Link) -> None:
        """Use this link from now on."""
        self.link = link
        self.features = Features.of(link)
        self._loop = asyncio.get_running_loop()

    @property
    def loop(self) -> asyncio.AbstractEventLoop:
        """The event loop, cached: looking it up is a system call in CPython 3.11."""
        return self._loop or asyncio.get_running_loop()

    def require_link(self) -> Link:
        """Return the link.

        Raises:
            LinkError: the reason why there is no session.
        """
        if self._waits.end_reason is not None:
            self._waits.raise_end()
        if self.link is None:
            raise ConnectionClosedError(f"{self.name}: not connected: open it first")
        return self.link

    @property
    def dialect(self) -> Dialect:
        """Dialect of this session.

        Raises:
            LinkError: there is no session.
        """
        return self.require_link().machine.dialect

    def require(self, message_type: type[m.Message]) -> None:
        """Check that the dialect has a message.

        Raises:
            UnsupportedError: the dialect has no such message.
            LinkError: there is no session.
        """
        if not self.dialect.has(message_type):
            raise self.dialect.unsupported(message_type)

    def deadline(self, timeout: float) -> float:
        """Return the loop time in ``timeout`` seconds.

        Raises:
            ConfigurationError: the timeout is no finite number of seconds, 0 or more.
        """
        return self.unchecked_deadline(check_seconds(timeout, "timeout", self.name))

    def unchecked_deadline(self, timeout: float) -> float:
        """Return the loop time in ``timeout`` seconds, without a check."""
        return (self._loop or asyncio.get_running_loop()).time() + timeout
