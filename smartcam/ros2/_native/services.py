"""Servers and clients of services through rclpy."""

from __future__ import annotations

import asyncio
import logging
import threading
from typing import TYPE_CHECKING, Any

from smartcam._user_code import ENDS_PROGRAM
from smartcam.exceptions import RosError, ServiceCallError, ServiceTimeoutError, SmartCamError
from smartcam.ros2._native.installed import rclpy, to_ros
from smartcam.ros2._native.spinning import NoReplyError
from smartcam.ros2._native.topics import profile_of
from smartcam.ros2._node.qos import QoS
from smartcam.ros2._node.refusals import refusal
from smartcam.ros2._node.services import MAX_CONCURRENT_CALLS, SERVER_POLL_INTERVAL
from smartcam.ros2._node.topics import message_of

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.ros2._native.node import NativeNode
    from smartcam.ros2._types.types import ServiceType

logger: logging.Logger = logging.getLogger("smartcam.ros2")

CALL_QUEUE_QOS = QoS(depth=2 * MAX_CONCURRENT_CALLS)
"""Quality of services: with ROS' own depth of 10, the oldest of more simultaneous calls is lost."""


class ServiceCalls:
    """Carries out the calls of a service in the event loop, and gives their replies to rclpy.

    Args:
        node: node of the service.
        name: name of the service.
        kind: type of the service.
        cls: rclpy's class of the type.
        handler: coroutine function that takes each request and returns the response.
        timeout: seconds of the handler's timeout.

    Attributes:
        calls: number of received calls.
        failed: number of calls that were refused, or got no reply.
    """

    def __init__(
        self,
        node: NativeNode,
        name: str,
        kind: ServiceType,
        cls: Any,
        handler: Callable[[Any], Awaitable[Any]],
        timeout: float,
    ) -> None:
        self.calls: int = 0
        self.failed: int = 0
        self._node, self._name, self._kind, self._cls = node, name, kind, cls
        self._handler, self._timeout = handler, timeout
        self._serialize = rclpy("serialization").serialize_message
        self._future = rclpy("task").Future
        self._under_way, self._lock, self._closed = 0, threading.Lock(), False
        self._tasks: set[asyncio.Task[None]] = set()

    async def on_request(self, request: Any, _response: Any) -> Any:
        """Return the response to a request; rclpy calls and awaits this in its own thread."""
        with self._lock:
            full = self._under_way >= MAX_CONCURRENT_CALLS
            self._under_way += not full
        if full:
            return self._reply(
                self._refused(f"{MAX_CONCURRENT_CALLS} calls are running, which is the most")
            )
        try:
            answered = self._future(executor=self._node.executor)
            if not self._node.in_loop(self._take, self._serialize(request), answered):
                raise NoReplyError
            return self._reply(await answered)
        finally:
            with self._lock:
                self._under_way -= 1

    def _reply(self, data: bytes | None) -> Any:
        if data is None:
            raise NoReplyError
        return rclpy("serialization").deserialize_message(data, self._cls.Response)

    def _take(self, data: bytes, answered: Any) -> None:
        self.calls += 1
        task = asyncio.get_running_loop().create_task(self._serve(data, answered))
        self._tasks.add(task)
        task.add_done_callback(lambda done: self._done(done, answered))
        if self._closed:
            task.cancel()

    def _done(self, task: asyncio.Task[None], answered: Any) -> None:
        self._tasks.discard(task)
        if not answered.done():  # the task was cancelled before it began
            self._answer(answered, self._refused("the call was cancelled"))

    def _answer(self, answered: Any, data: bytes | None) -> None:
        answered.set_result(data)
        self._node.wake()

    async def _serve(self, data: bytes, answered: Any) -> None:
        try:
            async with asyncio.timeout(self._timeout):
                reply = await self._handler(self._kind.request.decode(data, whole=False))
            encoded: bytes | None = self._kind.response.encode(message_of(reply, {}))
        except asyncio.CancelledError:
            self._answer(answered, self._refused("the call was cancelled"))
            raise
        except TimeoutError as exc:
            given_up = f"no answer in {self._timeout:g} s"
            encoded = self._refused(str(exc) if isinstance(exc, SmartCamError) else given_up)
        except SmartCamError as exc:
            encoded = self._refused(str(exc))
        except ENDS_PROGRAM:
            raise
        except BaseException as exc:
            logger.exception("%s ! its handler failed", self._name)
            encoded = self._refused(f"{type(exc).__name__}: {exc}")
        self._answer(answered, encoded)

    def _refused(self, why: str) -> bytes | None:
        self.failed += 1
        answer = refusal(self._kind, f"{self._name}: {why}", self._node.types)
        outcome = "was refused" if answer is not None else "had no reply"
        logger.warning("%s ! a call %s: %s", self._name, outcome, why)
        return None if answer is None else self._kind.response.encode(answer)

    def close(self) -> None:
        """Cancel running calls. Idempotent."""
        self._closed = True
        for task in self._tasks:
            task.cancel()

    async def wait_closed(self) -> None:
        """Wait until the cancelled calls have ended."""
        if self._tasks:
            await asyncio.wait(tuple(self._tasks))


class NativeService:
    """A service of a node through rclpy; created by :meth:`NativeNode.serve`.

    A lost client is not noticed, since no middleware reports it. Its call continues to the end.

    Attributes:
        name: absolute name of the service.
        type: type of requests and replies.
    """

    def __init__(
        self,
        node: NativeNode,
        name: str,
        kind: ServiceType,
        cls: Any,
        handler: Callable[[Any], Awaitable[Any]],
        timeout: float,
    ) -> None:
        self.name: str = name
        self.type: ServiceType = kind
        self._node, self._closed, self._raw = node, False, None
        self._calls = ServiceCalls(node, name, kind, cls, handler, timeout)
        if cls is not None:
            group = node.side_by_side
            made = self._calls.on_request
            self._raw = node.made(
                lambda ros: ros.create_service(
                    cls, name, made, qos_profile=profile_of(CALL_QUEUE_QOS), callback_group=group
                )
            )

    def close(self) -> None:
        """Stop serving, and cancel running calls. Idempotent."""
        if self._closed:
            return
        self._closed = True
        self._calls.close()
        if self._raw is not None:
            self._node.outbox.put(lambda: self._node.unmade("service", self._raw))
        self._node.forget(self)

    async def wait_closed(self) -> None:
        """Wait until the cancelled calls have ended."""
        await self._calls.wait_closed()


class NativeClient:
    """Calls a service through rclpy; created by :meth:`NativeNode.client`.

    Attributes:
        name: absolute name of the service.
        type: type of requests and replies.
    """

    def __init__(self, node: NativeNode, name: str, kind: ServiceType, cls: Any) -> None:
        self.name: str = name
        self.type: ServiceType = kind
        self._node, self._cls, self._closed = node, cls, False
        self._waiting: set[asyncio.Future[Any]] = set()
        self._raw = node.made(
            lambda ros: ros.create_client(
                cls, name, qos_profile=profile_of(CALL_QUEUE_QOS), callback_group=node.side_by_side
            )
        )

    @property
    def served(self) -> bool:
        """True if there is a server, as far as is known."""
        if self._closed:
            return False
        try:
            return bool(self._raw.service_is_ready())
        except Exception:  # noqa: BLE001 - the context has ended, so there is no server
            return False

    async def wait_served(self, timeout: float = 10.0) -> None:
        """Wait until there is a server.

        Raises:
            ServiceTimeoutError: no server is found within ``timeout`` seconds.
            ServiceCallError: the client is closed, or rclpy has ended.
        """
        try:
            async with asyncio.timeout(timeout):
                while not self.served:
                    self._check_open()
                    await asyncio.sleep(SERVER_POLL_INTERVAL)
        except TimeoutError as exc:
            raise ServiceTimeoutError(
                f"{self.name}: no server for {self.type.name} within {timeout:g} s",
                service=self.name,
            ) from exc

    def _check_open(self) -> None:
        try:
            self._node.check_open()
        except RosError as exc:
            raise ServiceCallError(str(exc), service=self.name) from exc
        if self._closed:
            raise ServiceCallError(f"{self.name}: this client is closed", service=self.name)

    async def call(self, request: object = None, /, *, timeout: float = 10.0, **fields: Any) -> Any:
        """Call the service, once there is a server.

        Args:
            request: a request of the type, or a mapping of its fields.
            timeout: seconds until a server exists and has replied.
            **fields: the fields, if no request is given.

        Raises:
            RosMessageError: the request is not of the type.
            ServiceTimeoutError: there is no server, or no reply came in time.
            ServiceCallError: the client was closed, or rclpy has ended.

        Cancellation: the client stays usable; whether the call is carried out is unknown.
        """
        loop = asyncio.get_running_loop()
        deadline = loop.time() + timeout
        message = to_ros(self.type.request, message_of(request, fields), self._cls.Request)
        self._check_open()
        await self.wait_served(timeout)
        reply: asyncio.Future[Any] = loop.create_future()
        self._waiting.add(reply)
        pending = self._ask(message, reply)
        try:
            async with asyncio.timeout_at(deadline):
                reply_message = await reply
        except TimeoutError as exc:
            raise ServiceTimeoutError(
                f"{self.name}: no reply within {timeout:g} s; whether the call was carried out is "
                "unknown",
                service=self.name,
            ) from exc
        finally:
            self._waiting.discard(reply)
            self._raw.remove_pending_request(pending)
        data = rclpy("serialization").serialize_message(reply_message)
        return self.type.response.decode(data, whole=False)

    def _ask(self, message: Any, reply: asyncio.Future[Any]) -> Any:
        def take(reply_message: Any) -> None:
            if not reply.done():
                reply.set_result(reply_message)

        try:
            future = self._raw.call_async(message)
        except Exception as exc:
            self._waiting.discard(reply)
            text = f"{self.name}: {type(exc).__name__}: {exc!s:.300}"
            raise ServiceCallError(text, service=self.name) from exc
        future.add_done_callback(
            lambda done: None if done.cancelled() else self._node.in_loop(take, done.result())
        )
        return future

    def fail(self, why: str) -> None:
        """End running calls."""
        for reply in self._waiting:
            if not reply.done():
                reply.set_exception(ServiceCallError(f"{self.name}: {why}", service=self.name))

    def close(self) -> None:
        """Stop calling, and end running calls. Idempotent."""
        if self._closed:
            return
        self._closed = True
        self.fail("this client was closed")
        self._node.outbox.put(lambda: self._node.unmade("client", self._raw))
        self._node.forget(self)
