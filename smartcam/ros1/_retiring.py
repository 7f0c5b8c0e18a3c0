"""Withdraw services from a bridge, before they are advertised and at the end of a link.

A bridge keeps the services of a lost link, and lets their callers wait forever. If a service is
advertised again, the bridge counts its calls from one again, while old calls wait for the same
numbers: a call might get the answer to another. The bridge takes a second to withdraw a service and
handles nothing else on that link, so links of their own are used.
"""

from __future__ import annotations

import asyncio
import json
import logging
import uuid
from typing import TYPE_CHECKING, Any

from smartcam.ros1._link import link_errors, web_socket

if TYPE_CHECKING:
    from collections.abc import Sequence

    import aiohttp

logger: logging.Logger = logging.getLogger("smartcam.ros1")

LINK_COUNT = 8
"""Largest number of links for the services of a node at a time."""
SECONDS_PER_SERVICE = 2.0
"""Seconds of the timeout for each service; a bridge takes one second to withdraw a service."""
SPARE_SECONDS = 5.0
"""Further seconds of the timeout, for opening the links and for a busy bridge."""
PROBED_SERVICE = "/rosout/get_loggers"
"""A service that every roscore has; its answer comes after the bridge has handled earlier calls."""


def make_call(service: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """Return a call of a service; its answer shows that all earlier operations were handled."""
    call_id = f"smartcam:{uuid.uuid4()}"
    return {"op": "call_service", "service": service, "id": call_id, "args": arguments}


async def withdraw_services(url: str, services: Sequence[str]) -> None:
    """Make a bridge withdraw services, whichever link advertised them; log failures."""
    shares = [share for start in range(LINK_COUNT) if (share := services[start::LINK_COUNT])]
    try:
        async with (
            asyncio.timeout(SPARE_SECONDS + SECONDS_PER_SERVICE * max(map(len, shares), default=0)),
            asyncio.TaskGroup() as group,
        ):
            for share in shares:
                group.create_task(_withdraw(url, share))
    except TimeoutError:
        logger.warning("%s: did not confirm that it has withdrawn services", url)


async def _withdraw(url: str, services: Sequence[str]) -> None:
    try:
        async with web_socket(url) as web:
            for service in services:
                await web.send_json({"op": "unadvertise_service", "service": service})
            await _wait_until_handled(web)
    except link_errors() as exc:
        logger.warning("%s: has not withdrawn %s: %s", url, ", ".join(services), exc)


async def _wait_until_handled(web: aiohttp.ClientWebSocketResponse) -> None:
    """Wait until a bridge has handled the earlier operations.

    Raises:
        ConnectionError: the bridge closed the link.
    """
    request = make_call(PROBED_SERVICE, {})
    await web.send_json(request)
    async for message in web:
        try:
            operation = json.loads(message.data)
        except (ValueError, TypeError, RecursionError):
            continue
        if isinstance(operation, dict) and operation.get("id") == request["id"]:
            return
    raise ConnectionError("the bridge closed the link")
