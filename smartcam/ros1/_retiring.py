"""Having a bridge forget services, of an earlier link or of ours at its end.

A bridge keeps a service whose link is gone, and has its callers wait without end. Advertised again,
it counts its calls from one again, while the old ones wait for the same numbers: one might get the
answer to another. So services are withdrawn before they are advertised, and at the end. Each takes
the bridge a second, in which it does nothing else for this link; so other links do it.
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
"""Side by side, for a node's services."""
PER_SERVICE = 2.0
"""Seconds for each, of which the bridge takes one."""
SPARE_SECONDS = 5.0
"""Seconds more, for the link and for a bridge that is busy."""
KNOWN = "/rosout/get_loggers"
"""A service that every roscore has. Its answer says that what was said before is done."""


def question(service: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """Return a call, which a bridge answers when it is through with all before."""
    mark = f"smartcam:{uuid.uuid4()}"
    return {"op": "call_service", "service": service, "id": mark, "args": arguments}


async def retire(url: str, services: Sequence[str]) -> None:
    """Have a bridge withdraw services, whoever advertised them; what fails is logged."""
    shares = [share for start in range(LINK_COUNT) if (share := services[start::LINK_COUNT])]
    try:
        async with (
            asyncio.timeout(SPARE_SECONDS + PER_SERVICE * max(map(len, shares), default=0)),
            asyncio.TaskGroup() as group,
        ):
            for share in shares:
                group.create_task(_retire(url, share))
    except TimeoutError:
        logger.warning("%s: does not say that it has withdrawn its services", url)


async def _retire(url: str, services: Sequence[str]) -> None:
    try:
        async with web_socket(url) as web:
            for service in services:
                await web.send_json({"op": "unadvertise_service", "service": service})
            await _answered(web)
    except link_errors() as exc:
        logger.warning("%s: has not withdrawn %s: %s", url, ", ".join(services), exc)


async def _answered(web: aiohttp.ClientWebSocketResponse) -> None:
    """Wait until a bridge is through with what it was told.

    Raises:
        ConnectionError: the bridge is gone.
    """
    asked = question(KNOWN, {})
    await web.send_json(asked)
    async for message in web:
        try:
            operation = json.loads(message.data)
        except (ValueError, TypeError, RecursionError):
            continue
        if isinstance(operation, dict) and operation.get("id") == asked["id"]:
            return
    raise ConnectionError("it closed the link")
