"""Make a running agent use renewed certificates, without a restart of the agent."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from typing import TYPE_CHECKING

from smartcam.exceptions import ConnectFailedError, SmartCamError

if TYPE_CHECKING:
    from collections.abc import Callable
    from contextlib import AbstractAsyncContextManager

    from smartcam.fleet._bus.zenoh import ZenohConnection
    from smartcam.fleet._security.certificates import Identity

logger: logging.Logger = logging.getLogger("smartcam.fleet")

CHECK_INTERVAL = 10.0
"""Seconds between two checks of the files."""

MAX_BUSY_WAIT = 600.0
"""Largest number of seconds to wait for a moment in which no command runs."""

BUSY_CHECK_INTERVAL = 0.05

REOPEN_TIMEOUT = 10.0

RETRY_DELAY = 1.0


class CertificateWatch:
    """Opens an agent's connection to the bus again when its certificates have changed.

    This is needed only for a connection that listens: Zenoh reads the files only at the start.
    If it only connects to others, Zenoh reads the files at each connection.

    Args:
        connection: the agent's connection to the bus, open.
        listens: whether the connection listens.
        busy: function that returns whether a command runs.
        without_nodes: context manager that closes the nodes of ROS while the connection is opened
            again.
    """

    def __init__(
        self,
        connection: ZenohConnection,
        *,
        listens: bool,
        busy: Callable[[], bool],
        without_nodes: Callable[[], AbstractAsyncContextManager[None]] = contextlib.nullcontext,
    ) -> None:
        self._connection, self._listens, self._busy, self._without_nodes = (
            connection,
            listens,
            busy,
            without_nodes,
        )
        self._logged_error = ""

    async def run(self) -> None:
        """Check the files periodically, forever."""
        identity = self._connection.identity
        while True:
            await asyncio.sleep(CHECK_INTERVAL)
            try:
                identity = await self._use_renewed(identity)
            except Exception:
                logger.exception("certificates ! looking at them failed; it is tried again")

    async def _use_renewed(self, known: Identity | None) -> Identity | None:
        """Use the certificates if they differ from the known ones; return their identity."""
        identity = await self._check_files()
        if identity is not None and known is not None and identity.digest != known.digest:
            if self._listens:
                await self._reopen()
            text = "certificates of %s were renewed; they expire at %s"
            logger.info(text, identity, identity.expires_at)
        return identity or known

    async def _check_files(self) -> Identity | None:
        """Return the identity in the files; None if they are not valid, which is logged once."""
        try:
            identity = await self._connection.check_certificates()
        except SmartCamError as exc:
            if str(exc) != self._logged_error:
                text = "certificates ! the new files are not valid, the old ones stay in use: %s"
                logger.error(text, exc)  # noqa: TRY400 - the text says it
            self._logged_error = str(exc)
            return None
        self._logged_error = ""
        return identity

    async def _reopen(self) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(MAX_BUSY_WAIT):
                while self._busy():  # noqa: ASYNC110 - there is no event for it
                    await asyncio.sleep(BUSY_CHECK_INTERVAL)
        async with self._without_nodes():
            while True:
                try:
                    await self._connection.reopen(REOPEN_TIMEOUT)
                except ConnectFailedError as exc:
                    logger.error("certificates ! %s; it is tried again", exc)  # noqa: TRY400
                    await asyncio.sleep(RETRY_DELAY)
                else:
                    return
