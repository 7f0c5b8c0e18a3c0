"""A node of rclpy, and the thread that creates, spins and destroys it."""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import logging
import threading
import time
import weakref
from typing import TYPE_CHECKING, Any, cast

from smartcam._ros_names import check_domain
from smartcam.exceptions import ConfigurationError, RosError
from smartcam.ros2._native.installed import installed_distribution, rclpy
from smartcam.ros2._types.types import RosTypes

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

logger: logging.Logger = logging.getLogger("smartcam.ros2")

EXECUTOR_THREADS = 4
"""Threads of a node's executor: setting a parameter blocks one until the hook has answered."""

CHECK_INTERVAL = 1.0
"""Seconds between two checks in which a spinning thread looks whether its event loop still runs."""

ERROR_PAUSE = 0.05
"""Seconds for which a spinning thread pauses after an error: it may repeat at once."""

EXIT_TIMEOUT = 2.0
"""Seconds for which the end of the program waits for a node that was not closed."""

MAX_LOGGED_TEXTS = 100
"""Largest number of remembered errors of a spinning thread, each of which is logged once."""


class NoReplyError(Exception):
    """A call gets no reply; raised in a callback, and caught by the spinning thread."""


class NativeContext:
    """The context of rclpy that nodes share, opened by the first node.

    Args:
        domain: number of the domain; None for the value of the variable ``ROS_DOMAIN_ID``, or 0.
        distribution: name of the distribution whose messages are used; "": that of the installed
            ROS, as far as it is known.
        args: arguments for ROS, such as ``--ros-args -p use_sim_time:=true``.

    Raises:
        ConfigurationError: there is no such domain or distribution, or no rclpy.
        MissingExtraError: the extra ``ros2`` is not installed.
    """

    def __init__(
        self, *, domain: int | None = None, distribution: str = "", args: Sequence[str] = ()
    ) -> None:
        self.domain: int | None = None if domain is None else check_domain(domain)
        self.args: tuple[str, ...] = tuple(args)
        rclpy()
        self.types: RosTypes = RosTypes(distribution or installed_distribution())
        self._lock = threading.Lock()
        self._context: Any = None
        self._user_count = 0

    def open(self) -> Any:
        """Return the context of rclpy, for one more user; blocks.

        Raises:
            ConfigurationError: rclpy refuses the arguments for ROS.
            RosError: rclpy does not start.
        """
        with self._lock:
            if not self._user_count:
                self._context = self._create_context()
            self._user_count += 1
            return self._context

    def _create_context(self) -> Any:
        context = rclpy("context").Context()
        no_signals = rclpy("signals").SignalHandlerOptions.NO  # the program handles signals
        try:
            rclpy().init(
                args=["smartcam", *self.args],
                context=context,
                domain_id=self.domain,
                signal_handler_options=no_signals,
            )
        except Exception as exc:
            kind = ConfigurationError if self.args else RosError
            raise kind(f"rclpy does not begin: {type(exc).__name__}: {exc!s:.300}") from exc
        return context

    def close(self) -> None:
        """Release the context for one user; the last one shuts it down; blocks."""
        with self._lock:
            self._user_count -= 1
            if self._user_count:
                return
            context, self._context = self._context, None
        with contextlib.suppress(Exception):  # the context may already be shut down
            context.try_shutdown()


class SpunNode:
    """A node of rclpy, created, spun and destroyed by its own thread.

    Args:
        context: context that the node shares with others.
        name: name of the node.
        namespace: namespace of the node.
        loop: event loop of the node's users.
        on_end: function called in the event loop when the thread has ended, with the reason, or
            None after :meth:`stop`.
        managed: whether the node has a life cycle.

    Attributes:
        rclpy_node: the node of rclpy; None before it is created.
        executor: executor of rclpy; None before the node is created.
    """

    def __init__(
        self,
        context: NativeContext,
        name: str,
        namespace: str,
        loop: asyncio.AbstractEventLoop,
        on_end: Callable[[RosError | None], None],
        *,
        managed: bool,
    ) -> None:
        self.rclpy_node: Any = None
        self.executor: Any = None
        self._context, self._name, self._namespace = context, name, namespace
        self._loop, self._on_end, self._managed = loop, on_end, managed
        self._stop_requested = threading.Event()
        self._logged: set[str] = set()
        self._created: asyncio.Future[None] = loop.create_future()
        self._thread = threading.Thread(
            target=self._run, name=f"smartcam-rclpy {namespace}/{name}", daemon=True
        )

    async def start(self, timeout: float) -> None:
        """Create the node, and spin it.

        Raises:
            ConfigurationError: rclpy refuses its arguments.
            RosError: rclpy cannot create the node, or not in time.

        Cancellation: the thread ends by itself.
        """
        _open_nodes.add(self)
        self._thread.start()
        try:
            async with asyncio.timeout(timeout):
                await asyncio.shield(self._created)
        except TimeoutError as exc:
            self.stop()
            raise RosError(f"{self._name}: rclpy made no node within {timeout:g} s") from exc
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """Make the thread destroy the node and end."""
        self._stop_requested.set()
        with contextlib.suppress(Exception):  # the executor may be ending
            if self.executor is not None:
                self.executor.create_task(_nothing, None)  # only a task wakes the executor

    def wake(self) -> None:
        """Wake the thread, so that it finds new endpoints."""
        with contextlib.suppress(Exception):  # the executor may be ending
            if self.executor is not None:
                self.executor.wake()

    def call_in_loop(self, function: Callable[..., None], *args: Any) -> bool:
        """Call a function in the event loop; return False if the loop is closed."""
        try:
            self._loop.call_soon_threadsafe(function, *args)
        except RuntimeError:
            return False
        return True

    def stop_at_exit(self) -> None:
        """End a node that is still open at the program's end, in bounded time."""
        self.stop()
        self._thread.join(EXIT_TIMEOUT)

    # ------------------------------------------------------------------ in the thread

    def _run(self) -> None:
        reason: RosError | None = None
        try:
            context = self._context.open()
        except BaseException as exc:  # noqa: BLE001 - passed to start()
            self.call_in_loop(self._report_created, exc)
            _open_nodes.discard(self)
            return
        try:
            self._create_node(context)
            self.call_in_loop(self._report_created, None)
            reason = self._spin(context)
        except BaseException as exc:  # noqa: BLE001 - passed to start(), or to on_end
            reason = RosError(f"{self._name}: {type(exc).__name__}: {exc!s:.300}")
        finally:
            self._close()
            self._context.close()
            _open_nodes.discard(self)
            self.call_in_loop(self._report_created, reason)
            self.call_in_loop(self._on_end, reason)

    def _report_created(self, error: BaseException | None) -> None:
        if self._created.done():
            return
        if error is None:
            self._created.set_result(None)
        else:
            self._created.set_exception(error)
            self._created.exception()  # start() may have been cancelled

    def _create_node(self, context: Any) -> None:
        namespace = "" if self._namespace == "/" else self._namespace
        make = managed_node if self._managed else rclpy("node").Node
        self.rclpy_node = make(self._name, namespace=namespace, context=context)
        self.executor = rclpy("executors").MultiThreadedExecutor(EXECUTOR_THREADS, context=context)
        self.executor.add_node(self.rclpy_node)

    def _spin(self, context: Any) -> RosError | None:
        """Spin until the end; return its reason, None after :meth:`stop`."""
        shut_down = rclpy("executors").ExternalShutdownException
        while not self._stop_requested.is_set():
            if self._loop.is_closed():
                logger.error("%s ! its event loop is closed: the node is destroyed", self._name)
                return RosError(f"{self._name}: its event loop is closed")
            if not context.ok():
                return RosError(f"{self._name}: rclpy's context was shut down: the node is gone")
            try:
                self.executor.spin_once(CHECK_INTERVAL)
            except shut_down:
                continue
            except NoReplyError:
                pass
            except Exception as exc:  # noqa: BLE001 - mostly of an endpoint closed meanwhile
                self._log_error_once(exc)
        return None

    def _log_error_once(self, error: Exception) -> None:
        text = f"{type(error).__name__}: {error!s:.300}"
        is_closed = type(error).__name__ == "InvalidHandle"
        if text not in self._logged and len(self._logged) < MAX_LOGGED_TEXTS:
            self._logged.add(text)
            level = logging.DEBUG if is_closed else logging.WARNING
            logger.log(level, "%s ! a callback of rclpy failed: %s", self._name, text)
        time.sleep(ERROR_PAUSE)

    def _close(self) -> None:
        with contextlib.suppress(Exception):  # the handles end with their context
            self.executor.shutdown(EXIT_TIMEOUT)
        with contextlib.suppress(Exception):
            self.rclpy_node.destroy_node()
        # rclpy's state machine would keep the node in the graph until both are garbage collected
        vars(self.rclpy_node or self).pop("_state_machine", None)
        self.rclpy_node = self.executor = None


def managed_node(name: str, *, namespace: str, context: Any) -> Any:
    """Return a node of rclpy with a life cycle whose services run concurrently; blocks."""
    lifecycle_module, groups = rclpy("lifecycle"), rclpy("callback_groups")
    node_class = rclpy("node").Node
    bases = (lifecycle_module.LifecycleNodeMixin, node_class)
    node = cast("Any", type("SmartcamNode", bases, {"__init__": _nothing}))()
    node_class.__init__(node, name, namespace=namespace, context=context)
    lifecycle_module.LifecycleNodeMixin.__init__(
        node,
        enable_communication_interface=True,
        callback_group=groups.ReentrantCallbackGroup(),
    )
    return node


def _nothing(_self: Any) -> None:
    pass


_open_nodes: weakref.WeakSet[SpunNode] = weakref.WeakSet()


@atexit.register
def _stop_open_nodes() -> None:
    for spun in tuple(_open_nodes):
        spun.stop_at_exit()
