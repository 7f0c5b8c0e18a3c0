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
from smartcam.ros2._native.topics import rclpy_profile
from smartcam.ros2._node.qos import QoS
from smartcam.ros2._node.refusals import refusal_response
from smartcam.ros2._node.services import MAX_CONCURRENT_CALLS, SERVER_POLL_INTERVAL
from smartcam.ros2._node.topics import message_or_fields

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from smartcam.ros2._native.node import NativeNode
    from smartcam.ros2._types.types import ServiceType

logger: logging.Logger = logging.getLogger("smartcam.ros2")

CALL_QUEUE_QOS = QoS(depth=2 * MAX_CONCURRENT_CALLS)
"""Quality of services. With ROS' own depth of 10, the oldest of more than 10 simultaneous calls
would be lost."""


class ServiceCalls:
    """Carries out the calls of a service in the event loop, and gives their replies to rclpy.

    Args:
        node: node of the service.
        name: name of the service.
        service_type: type of the service.
        rclpy_type: rclpy's class of the type.
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
        service_type: ServiceType,
        rclpy_type: Any,
        handler: Callable[[Any], Awaitable[Any]],
        timeout: float,
    ) -> None:
        self.calls: int = 0
        self.failed: int = 0
        self._node, self._name = node, name
        self._service_type, self._rclpy_type = service_type, rclpy_type
        self._handler, self._timeout = handler, timeout
        self._serialize = rclpy("serialization").serialize_message
        self._future = rclpy("task").Future
        self._running_count, self._lock, self._closed = 0, threading.Lock(), False
        self._tasks: set[asyncio.Task[None]] = set()

    async def on_request(self, request: Any, _response: Any) -> Any:
        """Return the response to a request; rclpy calls and awaits this in its own thread."""
        with self._lock:
            is_full = self._running_count >= MAX_CONCURRENT_CALLS
            self._running_count += not is_full
        if is_full:
            return self._reply(
                self._encode_refusal(f"{MAX_CONCURRENT_CALLS} calls are running, the maximum")
            )
        try:
            reply_future = self._future(executor=self._node.executor)
            if not self._node.call_in_loop(
                self._start_call, self._serialize(request), reply_future
            ):
                raise NoReplyError
            return self._reply(await reply_future)
        finally:
            with self._lock:
                self._running_count -= 1

    def _reply(self, data: bytes | None) -> Any:
        if data is None:
            raise NoReplyError
        return rclpy("serialization").deserialize_message(data, self._rclpy_type.Response)

    def _start_call(self, data: bytes, reply_future: Any) -> None:
        self.calls += 1
        task = asyncio.get_running_loop().create_task(self._serve(data, reply_future))
        self._tasks.add(task)
        task.add_done_callback(lambda done: self._on_task_done(done, reply_future))
        if self._closed:
            task.cancel()

    def _on_task_done(self, task: asyncio.Task[None], reply_future: Any) -> None:
        self._tasks.discard(task)
        if not reply_future.done():  # the task was cancelled before it began
            self._set_reply(reply_future, self._encode_refusal("the call was cancelled"))

    def _set_reply(self, reply_future: Any, data: bytes | None) -> None:
        reply_future.set_result(data)
        self._node.wake()

    async def _serve(self, data: bytes, reply_future: Any) -> None:
        try:
            async with asyncio.timeout(self._timeout):
                reply = await self._handler(self._service_type.request.decode(data, whole=False))
            encoded: bytes | None = self._service_type.response.encode(message_or_fields(reply, {}))
        except asyncio.CancelledError:
            self._set_reply(reply_future, self._encode_refusal("the call was cancelled"))
            raise
        except TimeoutError as exc:
            timeout_text = f"no answer in {self._timeout:g} s"
            encoded = self._encode_refusal(
                str(exc) if isinstance(exc, SmartCamError) else timeout_text
            )
        except SmartCamError as exc:
            encoded = self._encode_refusal(str(exc))
        except ENDS_PROGRAM:
            raise
        except BaseException as exc:
            logger.exception("%s ! its handler failed", self._name)
            encoded = self._encode_refusal(f"{type(exc).__name__}: {exc}")
        self._set_reply(reply_future, encoded)

    def _encode_refusal(self, reason: str) -> bytes | None:
        self.failed += 1
        answer = refusal_response(self._service_type, f"{self._name}: {reason}", self._node.types)
        outcome = "was refused" if answer is not None else "had no reply"
        logger.warning("%s ! a call %s: %s", self._name, outcome, reason)
        return None if answer is None else self._service_type.response.encode(answer)

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
        service_type: ServiceType,
        rclpy_type: Any,
        handler: Callable[[Any], Awaitable[Any]],
        timeout: float,
    ) -> None:
        self.name: str = name
        self.type: ServiceType = service_type
        self._node, self._closed, self._ros_object = node, False, None
        self._calls = ServiceCalls(node, name, service_type, rclpy_type, handler, timeout)
        if rclpy_type is not None:
            group = node.concurrent_group
            callback = self._calls.on_request
            self._ros_object = node.call_rclpy(
                lambda rclpy_node: rclpy_node.create_service(
                    rclpy_type,
                    name,
                    callback,
                    qos_profile=rclpy_profile(CALL_QUEUE_QOS),
                    callback_group=group,
                )
            )

    def close(self) -> None:
        """Stop serving, and cancel running calls. Idempotent."""
        if self._closed:
            return
        self._closed = True
        self._calls.close()
        if self._ros_object is not None:
            self._node.outbox.add_job(lambda: self._node.destroy("service", self._ros_object))
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

    def __init__(
        self, node: NativeNode, name: str, service_type: ServiceType, rclpy_type: Any
    ) -> None:
        self.name: str = name
        self.type: ServiceType = service_type
        self._node, self._rclpy_type, self._closed = node, rclpy_type, False
        self._replies: set[asyncio.Future[Any]] = set()
        self._ros_object = node.call_rclpy(
            lambda rclpy_node: rclpy_node.create_client(
                rclpy_type,
                name,
                qos_profile=rclpy_profile(CALL_QUEUE_QOS),
                callback_group=node.concurrent_group,
            )
        )

    @property
    def served(self) -> bool:
        """True if there is a server, as far as is known."""
        if self._closed:
            return False
        try:
            return bool(self._ros_object.service_is_ready())
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
        message = message_or_fields(request, fields)
        ros_request = to_ros(self.type.request, message, self._rclpy_type.Request)
        self._check_open()
        await self.wait_served(timeout)
        reply: asyncio.Future[Any] = loop.create_future()
        self._replies.add(reply)
        ros_future = self._send_request(ros_request, reply)
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
            self._replies.discard(reply)
            self._ros_object.remove_pending_request(ros_future)
        data = rclpy("serialization").serialize_message(reply_message)
        return self.type.response.decode(data, whole=False)

    def _send_request(self, message: Any, reply: asyncio.Future[Any]) -> Any:
        def set_reply(reply_message: Any) -> None:
            if not reply.done():
                reply.set_result(reply_message)

        try:
            future = self._ros_object.call_async(message)
        except Exception as exc:
            self._replies.discard(reply)
            text = f"{self.name}: {type(exc).__name__}: {exc!s:.300}"
            raise ServiceCallError(text, service=self.name) from exc
        future.add_done_callback(
            lambda done: (
                None if done.cancelled() else self._node.call_in_loop(set_reply, done.result())
            )
        )
        return future

    def fail_calls(self, reason: str) -> None:
        """End running calls."""
        for reply in self._replies:
            if not reply.done():
                reply.set_exception(ServiceCallError(f"{self.name}: {reason}", service=self.name))

    def close(self) -> None:
        """Stop calling, and end running calls. Idempotent."""
        if self._closed:
            return
        self._closed = True
        self.fail_calls("this client was closed")
        self._node.outbox.add_job(lambda: self._node.destroy("client", self._ros_object))
        self._node.forget(self)
