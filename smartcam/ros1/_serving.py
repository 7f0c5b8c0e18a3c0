"""Services for callers behind a rosbridge."""

from __future__ import annotations

import asyncio
import logging
from typing import TYPE_CHECKING, Any

from smartcam._user_code import ENDS_PROGRAM
from smartcam.exceptions import RosError, SmartCamError
from smartcam.ros1._json_messages import encode_operation, from_json, ros1_name, to_json

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable
    from typing import Self

    from smartcam.ros1._json_messages import TextPart
    from smartcam.ros1._rosbridge import RosbridgeNode
    from smartcam.ros2._inside import MessageType, ServiceType

logger: logging.Logger = logging.getLogger("smartcam.ros1")

MAX_CONCURRENT_CALLS = 64
"""Largest number of calls of a service that run at the same time; further calls are refused."""
RESPONSE_TRANSFER_TIME = 0.5
"""Seconds for a bridge to pass on a response before its service is withdrawn. The bridge
would pass on a response that it still has to a later caller."""
CLOSE_TIMEOUT = 5.0
"""Seconds to wait for cancelled handlers; a handler that continues longer is wrong."""
ERROR_FIELDS = ("error", "message", "status_message")
"""Names of fields for an error's text; the first one that a response has is used."""


class RosbridgeService:
    """A service, made by :meth:`RosbridgeNode.serve`.

    Attributes:
        name: absolute name of the service.
        type: type of requests and responses.
        is_advertised: True if the service is advertised to the present bridge.
        has_ros1_type: True if ROS 1 has the type; otherwise the service is not served.
        calls: number of calls.
        failed: number of calls that were refused, or failed.
    """

    def __init__(
        self,
        node: RosbridgeNode,
        name: str,
        message_type: ServiceType,
        handler: Callable[[Any], Awaitable[Any]],
        timeout: float,
    ) -> None:
        self.name: str = name
        self.type: ServiceType = message_type
        self.is_advertised: bool = False
        self.has_ros1_type: bool = ros1_name(message_type.name) is not None
        self.calls: int = 0
        self.failed: int = 0
        self._node, self._handler, self._timeout = node, handler, timeout
        self._tasks: set[asyncio.Task[None]] = set()
        self._last_response_at = float("-inf")
        self._advertisement_number = (
            0  # number of the advertisement: calls of an earlier one are not answered
        )
        self._text_field = error_field(message_type.response)

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
            self.is_advertised = True

    def discard_calls(self) -> None:
        """Leave running calls without an answer: the bridge may reuse their numbers."""
        self.is_advertised = False
        self._advertisement_number += 1

    async def stop_calls(self) -> None:
        """Cancel running calls, and give the bridge time to pass on the responses that it has."""
        self.discard_calls()
        for task in self._tasks:
            task.cancel()
        if self._tasks:
            await asyncio.wait(tuple(self._tasks), timeout=CLOSE_TIMEOUT)
        remaining = (
            self._last_response_at + RESPONSE_TRANSFER_TIME - asyncio.get_running_loop().time()
        )
        if remaining > 0:
            await asyncio.sleep(remaining)

    def start_call(self, identity: object, arguments: object) -> None:
        """Start a call, which is cancelled if the bridge is lost."""
        self.calls += 1
        is_full = len(self._tasks) >= MAX_CONCURRENT_CALLS
        task = self._node.begin(self._run_call(identity, arguments, is_full=is_full))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    # ------------------------------------------------------------------ inside

    async def _run_call(self, identity: object, arguments: object, *, is_full: bool) -> None:
        advertisement_number = self._advertisement_number
        try:
            parts = await self._make_response(identity, arguments, is_full=is_full)
        except SmartCamError as exc:
            self._refuse(advertisement_number, identity, str(exc))
        except TimeoutError:
            self._refuse(advertisement_number, identity, f"no answer in {self._timeout:g} s")
        except asyncio.CancelledError:
            raise
        except ENDS_PROGRAM:
            raise
        except BaseException as exc:
            logger.exception("%s ! its handler failed", self.name)
            self._refuse(advertisement_number, identity, f"{type(exc).__name__}: {exc}")
        else:
            self._respond(advertisement_number, parts)

    async def _make_response(
        self, identity: object, arguments: object, *, is_full: bool
    ) -> tuple[TextPart, ...]:
        if is_full:
            raise RosError(f"{MAX_CONCURRENT_CALLS} calls are running, the maximum")
        request = from_json(self.type.request, {} if arguments is None else arguments)
        async with asyncio.timeout(self._timeout):
            response = await self._handler(request)
        return self._encode_response(identity, to_json(self.type.response, response), result=True)

    def _refuse(self, advertisement_number: int, identity: object, text: str) -> None:
        self.failed += 1
        logger.warning("%s ! %s", self.name, text)
        message_type = self.type.response
        if self._text_field:
            values = to_json(message_type, {self._text_field: text})
            self._respond(
                advertisement_number, self._encode_response(identity, values, result=False)
            )
        elif advertisement_number == self._advertisement_number:
            # A bridge ignores ``result`` and would pass on a response of zeros. The caller gets an
            # error because the service is withdrawn before the bridge passes on this response.
            self._respond(advertisement_number, self._encode_response(identity, None, result=False))
            self._node.renew(self)

    def _encode_response(
        self, identity: object, values: object, *, result: bool
    ) -> tuple[TextPart, ...]:
        operation = {"op": "service_response", "service": self.name, "result": result}
        if identity is not None:
            operation["id"] = identity
        if values is not None:
            operation["values"] = values
        return encode_operation(operation)

    def _respond(self, advertisement_number: int, parts: tuple[TextPart, ...]) -> None:
        if advertisement_number == self._advertisement_number:
            self._last_response_at = asyncio.get_running_loop().time()
            self._node.send(parts)

    def _send(self, operation: dict[str, Any]) -> None:
        self._node.send(encode_operation({**operation, "service": self.name}))


def error_field(message_type: MessageType) -> str:
    """Return the field of a response for an error's text, "" if it has none."""
    texts = {
        field.name for field in message_type.fields if field.type == "string" and not field.shape
    }
    return next((field for field in ERROR_FIELDS if field in texts), "")
