"""Services for callers behind a rosbridge."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any

from smartcam._user_code import ENDS_PROGRAM
from smartcam.exceptions import RosError, SmartCamError
from smartcam.ros1._json_messages import encoded, from_json, ros1_name, to_json

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from typing import Self

    from smartcam.ros1._json_messages import Part
    from smartcam.ros1._rosbridge import RosbridgeNode
    from smartcam.ros2._inside import MessageType, ServiceType

logger: logging.Logger = logging.getLogger("smartcam.ros1")

MAX_CONCURRENT_CALLS = 64
"""Largest number of calls of a service that are carried out at the same time; further ones are
refused."""
SETTLE_TIME = 0.5
"""Seconds for a bridge to pass on a response before its service is withdrawn. A response that
remains in the bridge would become that to a later call."""
CLOSE_TIMEOUT = 5.0
"""Seconds to wait for cancelled handlers; a handler that goes on is its author's fault."""
ERROR_FIELDS = ("error", "message", "status_message")
"""Fields of a response for an error's text; the first that the response has is used."""


class RosbridgeService:
    """A service, made by :meth:`RosbridgeNode.serve`.

    Attributes:
        name: absolute name of the service.
        type: type of requests and responses.
        ready: whether the service is advertised to the present bridge.
        calls: number of calls.
        failed: number of calls that were refused, or failed.
    """

    def __init__(
        self,
        node: RosbridgeNode,
        name: str,
        kind: ServiceType,
        handler: Callable[[Any], Awaitable[Any]],
        timeout: float,
    ) -> None:
        self.name: str = name
        self.type: ServiceType = kind
        self.ready: bool = False
        self.exists: bool = ros1_name(kind.name) is not None
        self.calls: int = 0
        self.failed: int = 0
        self._node, self._handler, self._timeout = node, handler, timeout
        self._tasks: set[asyncio.Task[None]] = set()
        self._responded = float("-inf")
        self._turn = 0  # number of the advertisement: calls of an earlier one are not answered
        self._text_field = error_field(kind.response)

    def close(self) -> None:
        """Close the service; calls under way fail at their callers. Idempotent."""
        self._node.forget(self)

    async def wait_closed(self) -> None:
        """Wait until cancelled calls have ended."""
        if self._tasks:
            await asyncio.wait(tuple(self._tasks))

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()

    # ------------------------------------------------------------------ for the node

    def advertise(self) -> None:
        """Advertise the service, unless it is closed."""
        if self._node.has(self):
            self._send({"op": "advertise_service", "type": ros1_name(self.type.name)})
            self.ready = True

    def end_turn(self) -> None:
        """Answer no earlier call, since the bridge counts calls from one again."""
        self.ready = False
        self._turn += 1

    async def still(self) -> None:
        """End the calls under way, and let the bridge pass on the responses that it has."""
        self.end_turn()
        for task in self._tasks:
            task.cancel()
        if self._tasks:
            await asyncio.wait(tuple(self._tasks), timeout=CLOSE_TIMEOUT)
        left = self._responded + SETTLE_TIME - asyncio.get_running_loop().time()
        if left > 0:
            await asyncio.sleep(left)

    def call(self, identity: object, arguments: object) -> None:
        """Carry out a call, which is cancelled if the bridge is lost."""
        self.calls += 1
        busy = len(self._tasks) >= MAX_CONCURRENT_CALLS
        task = self._node.begin(self._carry_out(identity, arguments, busy=busy))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # ------------------------------------------------------------------ inside

    async def _carry_out(self, identity: object, arguments: object, *, busy: bool) -> None:
        turn = self._turn
        try:
            parts = await self._response(identity, arguments, busy=busy)
        except SmartCamError as exc:
            self._refuse(turn, identity, str(exc))
        except TimeoutError:
            self._refuse(turn, identity, f"no answer in {self._timeout:g} s")
        except asyncio.CancelledError:
            raise
        except ENDS_PROGRAM:
            raise
        except BaseException as exc:
            logger.exception("%s ! its handler failed", self.name)
            self._refuse(turn, identity, f"{type(exc).__name__}: {exc}")
        else:
            self._respond(turn, parts)

    async def _response(
        self, identity: object, arguments: object, *, busy: bool
    ) -> tuple[Part, ...]:
        if busy:
            raise RosError(f"{MAX_CONCURRENT_CALLS} calls of it are running, which is the most")
        request = from_json(self.type.request, {} if arguments is None else arguments)
        async with asyncio.timeout(self._timeout):
            response = await self._handler(request)
        return self._encoded(identity, to_json(self.type.response, response), result=True)

    def _refuse(self, turn: int, identity: object, text: str) -> None:
        self.failed += 1
        logger.warning("%s ! %s", self.name, text)
        kind = self.type.response
        if self._text_field:
            values = to_json(kind, {self._text_field: text})
            self._respond(turn, self._encoded(identity, values, result=False))
        elif turn == self._turn:
            # A bridge ignores ``result`` and would pass on zeros. So the service is withdrawn for a
            # moment, which is an error for its callers.
            self._respond(turn, self._encoded(identity, None, result=False))
            self._node.renew(self)

    def _encoded(self, identity: object, values: object, *, result: bool) -> tuple[Part, ...]:
        operation = {"op": "service_response", "service": self.name, "result": result}
        if identity is not None:
            operation["id"] = identity
        if values is not None:
            operation["values"] = values
        return encoded(operation)

    def _respond(self, turn: int, parts: tuple[Part, ...]) -> None:
        if turn == self._turn:
            self._responded = asyncio.get_running_loop().time()
            self._node.send(parts)

    def _send(self, operation: dict[str, Any]) -> None:
        self._node.send(encoded({**operation, "service": self.name}))


def error_field(kind: MessageType) -> str:
    """Return the field of a response for an error's text, "" if it has none."""
    texts = {field.name for field in kind.fields if field.type == "string" and not field.shape}
    return next((field for field in ERROR_FIELDS if field in texts), "")
