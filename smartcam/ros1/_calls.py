"""Services that are called through a rosbridge."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any

from smartcam.exceptions import SmartCamError
from smartcam.ros1._json_messages import from_json, ros1_name, to_json

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.ros1._rosbridge import RosbridgeNode
    from smartcam.ros2._types import MessageType, ServiceType

logger: logging.Logger = logging.getLogger("smartcam.ros1")

MOST_SECONDS = 900.0
"""That a call may take, whatever it asks for."""
SETTLE = 0.5
"""Seconds that a bridge gets to hand over a response before its service is withdrawn. One that it
has not handed over stays, and is then the response to a later call."""
ERROR_FIELDS = ("error", "message", "status_message")
"""The fields of a response that say what went wrong, the first that it has."""


class RosbridgeService:
    """A service that a node serves.

    Attributes:
        service: its full name.
        type: what it takes and gives.
        ready: whether it is advertised to the bridge that is there.
    """

    def __init__(
        self,
        node: RosbridgeNode,
        service: str,
        kind: ServiceType,
        handler: Callable[[Any], Awaitable[Any]],
    ) -> None:
        self.service, self.type = service, kind
        self.ready = False
        self._node, self._handler = node, handler
        self._calls: set[asyncio.Task[None]] = set()
        self._responded = float("-inf")
        self._text_field = error_field(kind.response)

    def close(self) -> None:
        """Stop serving; calls under way fail at their callers. Idempotent."""
        self._node._forget_service(self)  # noqa: SLF001 - its own

    # ------------------------------------------------------------------ for the node

    def advertise(self) -> None:
        """Advertise it."""
        self._say({"op": "advertise_service", "type": ros1_name(self.type.name)})
        self.ready = True

    async def withdraw(self) -> None:
        """Have the bridge withdraw it, so that its callers hear of it."""
        await self.still()
        self._say({"op": "unadvertise_service"})

    async def still(self) -> None:
        """Take no more calls, end those under way, and let the bridge hand over its responses."""
        self.ready = False
        calls = [one for one in self._calls if one is not asyncio.current_task()]
        for call in calls:
            call.cancel()
        if calls:
            await asyncio.wait(calls)
        left = self._responded + SETTLE - asyncio.get_running_loop().time()
        if left > 0:
            await asyncio.sleep(left)

    def call(self, identity: Any, said: Any, *, busy: bool) -> None:
        """Carry out a call."""
        task = self._node._start(self._answer(identity, said, busy=busy))  # noqa: SLF001
        self._calls.add(task)
        task.add_done_callback(self._calls.discard)

    # ------------------------------------------------------------------ inside

    async def _answer(self, identity: Any, said: Any, *, busy: bool) -> None:
        try:
            if busy:
                raise SmartCamError(f"{self.service}: too many calls are under way")
            request = from_json(self.type.request, {} if said is None else said)
            async with asyncio.timeout(MOST_SECONDS):
                response = await self._handler(request)
            values = to_json(self.type.response, response)
        except SmartCamError as exc:
            await self._refuse(identity, str(exc))
        except TimeoutError:
            await self._refuse(identity, f"{self.service}: no end within {MOST_SECONDS:g} s")
        except Exception as exc:
            logger.exception("%s", self.service)
            await self._refuse(identity, f"{self.service} failed: {type(exc).__name__}")
        else:
            self._respond(identity, values, result=True)

    async def _refuse(self, identity: Any, text: str) -> None:
        logger.warning("%s: refused: %s", self.service, text)
        kind = self.type.response
        if self._text_field:
            values = to_json(kind, kind.new(**{self._text_field: text}))
            self._respond(identity, values, result=False)
            return
        # A bridge takes no notice of ``result`` and would hand over zeros: the service goes for a
        # moment, which is an error for its callers.
        self._respond(identity, None, result=False)
        await self.withdraw()
        self.advertise()

    def _respond(self, identity: Any, values: Any, *, result: bool) -> None:
        said = {"op": "service_response", "result": result}
        if identity is not None:
            said["id"] = identity
        if values is not None:
            said["values"] = values
            self._responded = asyncio.get_running_loop().time()
        self._say(said)

    def _say(self, operation: dict[str, Any]) -> None:
        self._node._say({**operation, "service": self.service})  # noqa: SLF001


def error_field(kind: MessageType) -> str:
    """Return the field of a response that says what went wrong, "" where it has none."""
    texts = {one.name for one in kind.fields if one.type == "string" and not one.shape}
    return next((one for one in ERROR_FIELDS if one in texts), "")
