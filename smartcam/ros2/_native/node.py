"""A node of ROS 2 in asyncio, through the installed rclpy."""

from __future__ import annotations

import asyncio
import functools
import logging
import time
from typing import TYPE_CHECKING, Any, TypeVar

from smartcam.exceptions import ConfigurationError, RosError
from smartcam.ros2._native.graph import NativeGraph
from smartcam.ros2._native.installed import checked_message_class, checked_service_class, rclpy
from smartcam.ros2._native.lifecycle import NativeLifecycle
from smartcam.ros2._native.outbox import MessageThread
from smartcam.ros2._native.parameters import NativeParameters
from smartcam.ros2._native.services import NativeClient, NativeService
from smartcam.ros2._native.spinning import NativeContext, SpunNode
from smartcam.ros2._native.stamps import RosStamps
from smartcam.ros2._native.topics import NativePublisher, NativeSubscription
from smartcam.ros2._node.named_node import HANDLER_TIMEOUT, NamedNode
from smartcam.ros2._node.node import CLOSE_TIMEOUT
from smartcam.ros2._node.qos import DEFAULT, SERVICES, QoS

if TYPE_CHECKING:
    import concurrent.futures
    from collections.abc import Awaitable, Callable, Coroutine

    from smartcam.ros2._node.lifecycle import Lifecycle
    from smartcam.ros2._types.types import RosTypes

logger: logging.Logger = logging.getLogger("smartcam.ros2")

OPEN_TIMEOUT = 60.0
"""Seconds for rclpy to create a node; for the first one, rclpy is imported, which may take long."""

MISSING_LOG_DELAY = 1.0
"""Seconds after which missing packages are logged, all at once."""

BILLION = 1_000_000_000

Endpoint = TypeVar("Endpoint")


class NativeNode(NamedNode):
    """A node of ROS 2 through rclpy, for any middleware of ROS.

    Like :class:`smartcam.ros2.Node`, with ROS' own parameters, life cycle, graph and time. Topics
    and services whose types are not built for the installed ROS are left out, and logged.

    Args:
        name: name of the node, of letters, digits and ``_``.
        namespace: namespace of the node, such as ``/line1``.
        context: context shared with other nodes of this process; None for its own.
        domain: number of the domain; None for the value of the variable ``ROS_DOMAIN_ID``.
        managed: whether the node has a life cycle; if so, call :meth:`manage` once it is open.

    Attributes:
        parameters: parameters of the node.
        graph: view of the other nodes.

    Raises:
        ConfigurationError: a name or domain is not valid, or there is no rclpy.
        MissingExtraError: the extra ``ros2`` is not installed.
    """

    def __init__(
        self,
        name: str,
        *,
        namespace: str = "/",
        context: NativeContext | None = None,
        domain: int | None = None,
        managed: bool = True,
    ) -> None:
        super().__init__(name, namespace)
        self.context: NativeContext = context or NativeContext(domain=domain)
        self.parameters: NativeParameters = NativeParameters(self)
        self.graph: NativeGraph = NativeGraph(self)
        self.outbox: MessageThread
        self.concurrent_group: Any = None
        self.stamps: RosStamps = RosStamps(self._time_shift)
        self._clock: Any = None
        self._managed = managed
        self._spun_node: SpunNode | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._end_error: RosError | None = None
        self._thread_ended = asyncio.Event()
        self._endpoints: set[Any] = set()
        self._missing: dict[str, list[str]] = {}
        self._missing_timer: asyncio.TimerHandle | None = None

    @property
    def types(self) -> RosTypes:
        """The types of messages and services that the node knows."""
        return self.context.types

    @property
    def is_open(self) -> bool:
        """True from the end of ``start()`` until ``stop()``."""
        return self._spun_node is not None

    @property
    def rclpy_node(self) -> Any:
        """The node of rclpy."""
        return None if self._spun_node is None else self._spun_node.rclpy_node

    @property
    def executor(self) -> Any:
        """The executor of rclpy."""
        return None if self._spun_node is None else self._spun_node.executor

    @property
    def has_sim_time(self) -> bool:
        """True if ROS' time is not the system's, as the parameter ``use_sim_time`` is set."""
        return self._clock is not None and bool(self._clock.ros_time_is_active)

    def _time_shift(self) -> float:
        """Return the seconds by which ROS' time is ahead of the system's."""
        return float(self._clock.now().nanoseconds - time.time_ns()) / BILLION

    # ------------------------------------------------------------------ life

    async def start(self) -> None:
        """Open the node.

        Raises:
            RosError: rclpy cannot create the node.

        Cancellation: the node is closed.
        """
        if self._spun_node is not None:
            return
        self._loop = asyncio.get_running_loop()
        self._end_error, self._thread_ended = None, asyncio.Event()
        on_end = functools.partial(self._on_end, self._thread_ended)
        spun = SpunNode(
            self.context, self.name, self.namespace, self._loop, on_end, managed=self._managed
        )
        await spun.start(OPEN_TIMEOUT)
        self._spun_node = spun
        self.outbox = MessageThread(f"smartcam-rclpy-outbox {self.full_name}")
        self.concurrent_group = rclpy("callback_groups").ReentrantCallbackGroup()
        made = spun.rclpy_node
        self._clock = made.get_clock()
        self.name, self.namespace = made.get_name(), made.get_namespace()  # remapped
        try:
            self.parameters.open()
        except BaseException:
            await self.stop()
            raise

    def _on_end(self, ended: asyncio.Event, reason: RosError | None) -> None:
        ended.set()
        if reason is not None and ended is self._thread_ended and self._spun_node is not None:
            self._end_error = reason
            logger.error("%s", reason)
            for endpoint in tuple(self._endpoints):
                if isinstance(endpoint, NativeClient):
                    endpoint.fail_calls(str(reason))

    async def stop(self) -> None:
        """Close the node with its publishers, subscriptions and services. Idempotent, bounded."""
        spun = self._spun_node
        if spun is None:
            return
        self._report_missing()
        services = [endpoint for endpoint in self._endpoints if isinstance(endpoint, NativeService)]
        for endpoint in tuple(self._endpoints):
            endpoint.close()
        try:
            async with asyncio.timeout(CLOSE_TIMEOUT):
                await self.parameters.close()
                for service in services:
                    await service.wait_closed()
                await asyncio.to_thread(self.outbox.close, CLOSE_TIMEOUT / 2)
        except TimeoutError:
            pass  # a handler did not end when it was cancelled
        finally:
            self._spun_node = None
            spun.stop()
            await self._wait_for_thread()

    async def _wait_for_thread(self) -> None:
        try:
            async with asyncio.timeout(CLOSE_TIMEOUT):
                await self._thread_ended.wait()
        except TimeoutError:
            logger.warning("%s ! rclpy does not end", self.full_name)

    def check_open(self) -> None:
        """Do nothing while the node is open.

        Raises:
            RosError: the node is not open, or rclpy has ended.
        """
        if self._end_error is not None:
            raise RosError(str(self._end_error))
        super().check_open()

    # ------------------------------------------------------------------ for its endpoints

    def call_in_loop(self, function: Callable[..., None], *args: Any) -> bool:
        """Call a function in the event loop; return False if the loop is closed."""
        spun = self._spun_node
        return spun is not None and spun.call_in_loop(function, *args)

    def submit(
        self, make_coroutine: Callable[[], Coroutine[Any, Any, None]]
    ) -> concurrent.futures.Future[None]:
        """Run a coroutine in the event loop; return its future.

        Raises:
            RosError: the event loop is closed.
        """
        loop = self._loop
        if loop is None or loop.is_closed():
            raise RosError(f"{self.full_name}: its event loop is closed")
        return asyncio.run_coroutine_threadsafe(make_coroutine(), loop)

    def wake(self) -> None:
        """Wake rclpy, so that it notices new endpoints."""
        if self._spun_node is not None:
            self._spun_node.wake()

    def call_rclpy(self, call: Callable[[Any], Any]) -> Any:
        """Call a function with rclpy's node, and return what it returns.

        Raises:
            RosError: the call failed.
        """
        self.check_open()
        try:
            return call(self.rclpy_node)
        except Exception as exc:
            raise RosError(f"{self.full_name}: {type(exc).__name__}: {exc!s:.300}") from exc

    def destroy(self, kind: str, endpoint: Any) -> None:
        """Destroy an endpoint of rclpy."""
        rclpy_node = self.rclpy_node
        if rclpy_node is not None:
            getattr(rclpy_node, f"destroy_{kind}")(endpoint)

    def forget(self, endpoint: Any) -> None:
        """Forget a closed endpoint."""
        self._endpoints.discard(endpoint)

    def _register(self, endpoint: Endpoint) -> Endpoint:
        self._endpoints.add(endpoint)
        return endpoint

    # ------------------------------------------------------------------ endpoints

    def publisher(self, topic: str, type: str, *, qos: QoS = DEFAULT) -> NativePublisher:
        """Publish on a topic.

        Args:
            topic: name of the topic, absolute, relative to the namespace, or private (``~/it``).
            type: type of the messages, such as ``std_msgs/msg/String``.
            qos: quality of service.

        Raises:
            ConfigurationError: the topic is not valid, or the type is unknown or differs in ROS.
            RosError: the node is not open.
        """
        message_type, name = self.types.message(type), self._resolve_name(topic, "topic")
        rclpy_type = checked_message_class(message_type)
        self._note_missing(rclpy_type, type, name)
        return self._register(NativePublisher(self, name, message_type, qos, rclpy_type))

    def subscribe(self, topic: str, type: str, *, qos: QoS = DEFAULT) -> NativeSubscription:
        """Subscribe to a topic; read it by ``async for``.

        Args:
            topic: name of the topic, absolute, relative to the namespace, or private (``~/it``).
            type: type of the messages, such as ``std_msgs/msg/String``.
            qos: quality of service; its depth is the queue's length.

        Raises:
            ConfigurationError: the topic is not valid, or the type is not built for this ROS.
            RosError: the node is not open.
        """
        message_type, name = self.types.message(type), self._resolve_name(topic, "topic")
        rclpy_type = self._require_built(checked_message_class(message_type), type)
        return self._register(NativeSubscription(self, name, message_type, qos, rclpy_type))

    def serve(
        self,
        service: str,
        type: str,
        handler: Callable[[Any], Awaitable[Any]],
        *,
        qos: QoS = SERVICES,
        timeout: float = HANDLER_TIMEOUT,
    ) -> NativeService:
        """Serve a service.

        Args:
            service: name of the service, resolved like a topic's name.
            type: type of the service, such as ``std_srvs/srv/Trigger``.
            handler: coroutine function that takes each request and returns the response, or a
                mapping of its fields.
            qos: is ignored; ROS' own quality of service for services is used.
            timeout: seconds of the handler's timeout.

        Raises:
            ConfigurationError: the name is not valid, or the type is unknown or differs in ROS.
            RosError: the node is not open.
        """
        del qos
        service_type, name = self.types.service(type), self._resolve_name(service, "service")
        rclpy_type = checked_service_class(service_type)
        self._note_missing(rclpy_type, type, name)
        return self._register(NativeService(self, name, service_type, rclpy_type, handler, timeout))

    def client(self, service: str, type: str, *, qos: QoS = SERVICES) -> NativeClient:
        """Return a client that calls a service.

        Args:
            service: name of the service, resolved like a topic's name.
            type: type of the service, such as ``std_srvs/srv/Trigger``.
            qos: is ignored; ROS' own quality of service for services is used.

        Raises:
            ConfigurationError: the name is not valid, or the type is not built for this ROS.
            RosError: the node is not open.
        """
        del qos
        service_type, name = self.types.service(type), self._resolve_name(service, "service")
        return self._register(
            NativeClient(
                self,
                name,
                service_type,
                self._require_built(checked_service_class(service_type), type),
            )
        )

    def manage(
        self, lifecycle: Lifecycle, handler: Callable[[Any], Awaitable[Any]]
    ) -> NativeLifecycle:
        """Make ROS' own life cycle follow one of smartcam's.

        Args:
            lifecycle: life cycle that decides about the state.
            handler: coroutine function that answers ``change_state``.

        Raises:
            RosError: the node is not open.
        """
        self.check_open()
        return NativeLifecycle(self, lifecycle, handler)

    # ------------------------------------------------------------------ types that are not built

    def _require_built(self, rclpy_type: Any, type: str) -> Any:
        if rclpy_type is None:
            raise ConfigurationError(
                f"{type}: its package is not built for the ROS that is installed"
                f"{how_to_build(type)}"
            )
        return rclpy_type

    def _note_missing(self, rclpy_type: Any, type: str, name: str) -> None:
        if rclpy_type is not None:
            return
        self._missing.setdefault(type.partition("/")[0], []).append(name)
        if self._missing_timer is None:
            loop = asyncio.get_running_loop()
            self._missing_timer = loop.call_later(MISSING_LOG_DELAY, self._report_missing)

    def _report_missing(self) -> None:
        if self._missing_timer is not None:
            self._missing_timer.cancel()
            self._missing_timer = None
        missing, self._missing = self._missing, {}
        for package, names in missing.items():
            logger.warning(
                "%s ! without %s: %s is not built for the ROS that is installed%s",
                self.full_name,
                ", ".join(sorted(set(names))),
                package,
                how_to_build(package),
            )


def how_to_build(type: str) -> str:
    """Return instructions to install the package of a type, as the end of a sentence."""
    package = type.partition("/")[0]
    if package == "smartcam_msgs":
        return "; copy ros2/smartcam_msgs into a workspace, build it with colcon and source it"
    return f"; apt install ros-DISTRIBUTION-{package.replace('_', '-')}, or build and source it"
