"""Serve and call services.

As in ``rmw_service_data.cpp`` and ``rmw_client_data.cpp`` of rmw_zenoh: a service is a complete
queryable, and a reply repeats number and GID of its request.
"""

from __future__ import annotations

import asyncio
import collections
import logging
import time
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._user_code import ENDS_PROGRAM
from smartcam._zenoh import direct
from smartcam.exceptions import (
    RosError,
    RosMessageError,
    ServiceCallError,
    ServiceTimeoutError,
    SmartCamError,
)
from smartcam.ros2._node.attachment import Attachment
from smartcam.ros2._node.refusals import refusal_response
from smartcam.ros2._node.tokens import CLIENT, SERVICE
from smartcam.ros2._node.topics import RosEndpoint, message_or_fields

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.ros2._node.context import RosContext
    from smartcam.ros2._node.tokens import Entity
    from smartcam.ros2._types.types import ServiceType

logger: logging.Logger = logging.getLogger("smartcam.ros2")

MAX_CONCURRENT_CALLS = 64
"""Largest number of calls of a service that run at the same time. Further calls are refused; they
wait if the service's answers have no fields for a refusal."""

MAX_WAITING_CALLS = 256
"""Largest number of waiting calls of a service whose answers have no fields for a refusal."""
MAX_REQUEST_BYTES = 1 << 24
"""Largest number of bytes of a request."""

SERVER_POLL_INTERVAL = 0.02
"""Seconds between two checks whether a server exists."""


class _RequestedCall(NamedTuple):
    """A call of a client: Zenoh's query, the request's bytes, and the caller."""

    query: Any
    data: bytes
    attachment: Attachment


class RosService(RosEndpoint):
    """A service of a node; created by :meth:`Node.serve`.

    Attributes:
        type: type of requests and replies.
        calls: number of received calls.
        failed: number of calls that were not carried out.
    """

    def __init__(
        self,
        context: RosContext,
        entity: Entity,
        service_type: ServiceType,
        handler: Callable[[Any], Awaitable[Any]],
        timeout: float,
        on_close: Callable[[RosEndpoint], None],
    ) -> None:
        super().__init__(context, entity, on_close)
        self.type: ServiceType = service_type
        self.calls: int = 0
        self.failed: int = 0
        self._handler, self._timeout = handler, timeout
        self._tasks: dict[asyncio.Task[None], bytes] = {}
        self._waiting: collections.deque[_RequestedCall] = collections.deque()
        zenoh = context.zenoh

        def on_query(query: Any) -> None:
            data = b"" if query.payload is None else query.payload.to_bytes()
            attachment_bytes = None if query.attachment is None else query.attachment.to_bytes()
            zenoh.call_in_loop_uncounted(self._on_request, query, data, attachment_bytes)

        self._declare(
            lambda session: session.declare_queryable(entity.key, direct(on_query), complete=True)
        )
        self._declare_token()
        self._stop_listening = context.watch_endpoints(self.name, CLIENT, self._on_client)

    def _on_request(self, query: Any, data: bytes, attachment_bytes: bytes | None) -> None:
        self.calls += 1
        try:
            attachment = Attachment.decode(attachment_bytes)
        except RosError as exc:
            self._fail(query, exc)
            return
        call = _RequestedCall(query, data, attachment)
        is_full = len(self._tasks) >= MAX_CONCURRENT_CALLS
        if self._closed:
            self._refuse(call, RosError("the service is closed"))
        elif len(data) > MAX_REQUEST_BYTES:
            reason = f"a request of {len(data)} bytes: expected {MAX_REQUEST_BYTES} at most"
            self._refuse(call, RosMessageError(reason))
        elif is_full and not self._can_refuse and len(self._waiting) < MAX_WAITING_CALLS:
            self._waiting.append(call)
        elif is_full:
            reason = f"{MAX_CONCURRENT_CALLS} calls are running, the maximum"
            self._refuse(call, RosError(reason))
        else:
            self._start_call(call)

    @property
    def _can_refuse(self) -> bool:
        return refusal_response(self.type, "", self._context.types) is not None

    def _start_call(self, call: _RequestedCall) -> None:
        try:
            request = self.type.request.decode(call.data)
        except RosError as exc:
            self._refuse(call, exc)
            return
        task = asyncio.get_running_loop().create_task(self._serve(call, request))
        self._tasks[task] = call.attachment.gid
        task.add_done_callback(self._on_call_done)

    def _on_call_done(self, task: asyncio.Task[None]) -> None:
        del self._tasks[task]
        while self._waiting and len(self._tasks) < MAX_CONCURRENT_CALLS:
            self._start_call(self._waiting.popleft())

    async def _serve(self, call: _RequestedCall, request: object) -> None:
        try:
            async with asyncio.timeout(self._timeout):
                reply = await self._handler(request)
            data = self.type.response.encode(message_or_fields(reply, {}))
        except asyncio.CancelledError:
            self._refuse(call, RosError("the call was cancelled"))
            raise
        except TimeoutError as exc:
            reason = exc if isinstance(exc, SmartCamError) else f"no answer in {self._timeout:g} s"
            self._refuse(call, RosError(str(reason)))
        except SmartCamError as exc:
            self._refuse(call, exc)
        except ENDS_PROGRAM:
            raise
        except BaseException as exc:
            logger.exception("%s ! its handler failed", self.name)
            self._refuse(call, RosError(f"{type(exc).__name__}: {exc}"))
        else:
            self._reply(call, data)

    def _reply(self, call: _RequestedCall, data: bytes) -> None:
        attachment = call.attachment._replace(time=time.time_ns()).encode()
        self._context.zenoh.reply(call.query, [(self.entity.key, data)], attachment=attachment)

    def _refuse(self, call: _RequestedCall, reason: SmartCamError) -> None:
        """Answer by a response with the reason, or by an error if the type has no field for it."""
        answer = refusal_response(self.type, f"{self.name}: {reason}", self._context.types)
        if answer is None:
            self._fail(call.query, reason)
            return
        self.failed += 1
        logger.warning("%s ! a call was refused: %s", self.name, reason)
        self._reply(call, self.type.response.encode(answer))

    def _fail(self, query: Any, reason: SmartCamError) -> None:
        self.failed += 1
        logger.warning("%s ! a call had no reply: %s", self.name, reason)
        self._context.zenoh.refuse(query, f"{self.name}: {reason}")

    def _on_client(self, entity: Entity, present: bool) -> None:
        """Cancel the calls of a lost client."""
        if present:
            return
        remaining = [call for call in self._waiting if call.attachment.gid != entity.gid]
        self._waiting = collections.deque(remaining)
        for task, gid in self._tasks.items():
            if gid == entity.gid:
                task.cancel()

    def close(self) -> None:
        """Stop serving, and cancel running calls. Idempotent."""
        if not self._closed:
            super().close()
            self._stop_listening()
            waiting, self._waiting = self._waiting, collections.deque()
            for call in waiting:
                self._refuse(call, RosError("the service is closed"))
            for task in self._tasks:
                task.cancel()

    async def wait_closed(self) -> None:
        """Wait until the cancelled calls have ended."""
        if self._tasks:
            await asyncio.wait(tuple(self._tasks))


class RosClient(RosEndpoint):
    """Calls a service; created by :meth:`Node.client`.

    Attributes:
        type: type of requests and replies.
    """

    def __init__(
        self,
        context: RosContext,
        entity: Entity,
        service_type: ServiceType,
        on_close: Callable[[RosEndpoint], None],
    ) -> None:
        super().__init__(context, entity, on_close)
        self.type: ServiceType = service_type
        self._number = 0
        self._waiting: set[asyncio.Future[Any]] = set()
        self._querier: Any = None

        def declare(session: Any) -> Any:
            zenoh = context.zenoh.zenoh
            self._querier = session.declare_querier(
                entity.key,
                target=zenoh.QueryTarget.ALL_COMPLETE,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=86_400,  # the timeout of call() ends the wait earlier
                express=True,
            )
            return self._querier

        self._declare(declare)
        self._declare_token()

    @property
    def served(self) -> bool:
        """True if there is a server, as far as is known."""
        servers = self._context.graph.endpoints(self.name, SERVICE)
        return not self._closed and any(server.key == self.entity.key for server in servers)

    async def wait_served(self, timeout: float = 10.0) -> None:
        """Wait until there is a server.

        Raises:
            ServiceTimeoutError: no server is found within ``timeout`` seconds.
        """
        if self.served:
            return
        try:
            async with asyncio.timeout(timeout):
                while not self.served:
                    self._check_open()
                    await asyncio.sleep(SERVER_POLL_INTERVAL)
        except TimeoutError as exc:
            servers = self._context.graph.endpoints(self.name, SERVICE)
            others = [server.ros_type for server in servers]
            others_text = f", but one for {', '.join(others)}" if others else ""
            raise ServiceTimeoutError(
                f"{self.name}: no server for {self.type.name} {self.type.hash} within "
                f"{timeout:g} s{others_text}",
                service=self.name,
            ) from exc

    def _check_open(self) -> None:
        if self._closed:
            raise ServiceCallError(f"{self.name}: this client is closed", service=self.name)

    async def call(self, request: object = None, /, *, timeout: float = 10.0, **fields: Any) -> Any:
        """Call the service, once there is a server; return the first reply.

        Args:
            request: a request of the type, or a mapping of its fields.
            timeout: seconds until a server exists and has replied.
            **fields: the fields, if no request is given.

        Raises:
            RosMessageError: the value is not a request of the type, or the reply cannot be read.
            ServiceTimeoutError: there is no server, or no reply came in time.
            ServiceCallError: the server refused, or was lost.

        Cancellation: the client stays usable; whether the call is carried out is unknown.
        """
        loop = asyncio.get_running_loop()
        deadline = loop.time() + timeout
        data = self.type.request.encode(message_or_fields(request, fields))
        await self.wait_served(timeout)
        self._number += 1
        attachment = Attachment(self._number, time.time_ns(), self.entity.gid)
        reply: asyncio.Future[bytes] = loop.create_future()
        self._waiting.add(reply)
        try:
            self._send_request(data, attachment, reply)
            async with asyncio.timeout_at(deadline):
                reply_data = await reply
        except TimeoutError as exc:
            raise ServiceTimeoutError(
                f"{self.name}: no reply within {timeout:g} s; whether the call was carried out is "
                "unknown",
                service=self.name,
            ) from exc
        finally:
            self._waiting.discard(reply)
        return self.type.response.decode(reply_data)

    def _send_request(
        self, data: bytes, attachment: Attachment, reply: asyncio.Future[bytes]
    ) -> None:
        zenoh = self._context.zenoh
        refused: list[str] = []
        has_reply = False

        def set_reply(reply_data: bytes) -> None:
            if not reply.done():
                reply.set_result(reply_data)

        def set_error() -> None:
            if not reply.done():
                reason = (
                    refused[0]
                    if refused
                    else ("the call ended without a reply; whether it was carried out is unknown")
                )
                reply.set_exception(ServiceCallError(f"{self.name}: {reason}", service=self.name))

        def on_reply(answer: Any) -> None:
            nonlocal has_reply
            if answer.ok is None:
                refused.append(answer.err.payload.to_bytes()[:1000].decode(errors="replace"))
                return
            attachment_bytes = (
                None if answer.ok.attachment is None else answer.ok.attachment.to_bytes()
            )
            if self._is_reply_to(attachment, attachment_bytes):
                has_reply = True
                payload = answer.ok.payload.to_bytes()
                zenoh.call_in_loop(set_reply, len(payload), payload)

        def on_end() -> None:
            if not has_reply:  # after a reply, the event loop has been woken already
                zenoh.call_in_loop_uncounted(set_error)

        self._querier.get(
            direct(on_reply, on_end),
            payload=data,
            attachment=attachment.encode(),
        )

    def _is_reply_to(self, request: Attachment, attachment_bytes: bytes | None) -> bool:
        """Return True if a reply answers this call; called in a thread of Zenoh."""
        try:
            attachment = Attachment.decode(attachment_bytes)
        except RosMessageError as exc:
            logger.warning("%s ! a reply was ignored: %s", self.name, exc)
            return False
        if (attachment.number, attachment.gid) == (request.number, request.gid):
            return True
        logger.warning("%s ! a reply to another call was ignored: %s", self.name, attachment)
        return False

    def close(self) -> None:
        """Stop calling, and end running calls. Idempotent."""
        super().close()
        for reply in self._waiting:
            if not reply.done():
                reply.set_exception(
                    ServiceCallError(f"{self.name}: this client was closed", service=self.name)
                )
