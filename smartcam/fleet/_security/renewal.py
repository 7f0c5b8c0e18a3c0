"""Use renewed certificates in a running agent."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING

from smartcam.exceptions import ConnectFailedError, SmartCamError

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractAsyncContextManager

    from smartcam.fleet._bus.zenoh import ZenohEnd
    from smartcam.fleet._security.certificates import Identity

logger: logging.Logger = logging.getLogger("smartcam.fleet")

CHECK_INTERVAL = 10.0
"""Seconds between two checks of the files."""

MAX_WAIT = 600.0
"""Largest number of seconds to wait for a moment without a command, since a renewal can wait."""

LOOK_AGAIN = 0.05

REOPEN_TIMEOUT = 10.0

RETRY_AFTER = 1.0


class CertificateWatch:
    """Opens an agent's end of the bus again when its certificates have changed.

    Ends that only connect need nothing: the engine reads the files at each connection. An end that
    listens reads them only at its start.

    Args:
        end: the agent's end of the bus, open.
        listens: whether the end listens.
        busy: function that returns whether a command runs.
        away: context around a new session: on entry everything that cannot stay is closed.
    """

    def __init__(
        self,
        end: ZenohEnd,
        *,
        listens: bool,
        busy: Callable[[], bool],
        away: Callable[[], AbstractAsyncContextManager[None]] = contextlib.nullcontext,
    ) -> None:
        self._end, self._listens, self._busy, self._away = end, listens, busy, away
        self._trouble = ""

    async def run(self) -> None:
        """Check the files periodically, forever."""
        seen = self._end.identity
        while True:
            await asyncio.sleep(CHECK_INTERVAL)
            try:
                seen = await self._follow(seen)
            except Exception:
                logger.exception("certificates ! looking at them failed; it is tried again")

    async def _follow(self, seen: Identity | None) -> Identity | None:
        """Use the current certificates; return their identity."""
        identity = await self._look()
        if identity is not None and seen is not None and identity.digest != seen.digest:
            if self._listens:
                await self._reopen()
            text = "certificates ! those of %s were renewed: until %s"
            logger.info(text, identity, identity.ends)
        return identity or seen

    async def _look(self) -> Identity | None:
        """Return the identity in the certificates; None, logged once, if they are not valid."""
        try:
            identity = await self._end.look_at_certificates()
        except SmartCamError as exc:
            if str(exc) != self._trouble:
                logger.error("certificates ! not taken; all goes on as it was: %s", exc)  # noqa: TRY400 - the text says it
            self._trouble = str(exc)
            return None
        self._trouble = ""
        return identity

    async def _reopen(self) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(MAX_WAIT):
                while self._busy():  # noqa: ASYNC110 - many things end it
                    await asyncio.sleep(LOOK_AGAIN)
        async with self._away():
            while True:
                try:
                    await self._end.reopen(REOPEN_TIMEOUT)
                except ConnectFailedError as exc:
                    logger.error("certificates ! %s; it is tried again", exc)  # noqa: TRY400
                    await asyncio.sleep(RETRY_AFTER)
                else:
                    return
