"""The services and the topic of a node's parameters.

Names, QoS and answers are those of ``parameter_service.cpp`` and ``node_parameters.cpp`` of rclcpp:
an undeclared name leaves the answer empty.
"""

from __future__ import annotations

import asyncio
import logging
import time
from typing import TYPE_CHECKING, Any, Final, TypeVar

from smartcam.exceptions import SmartCamError
from smartcam.ros2._node.parameter_values import decode_value, encode_value
from smartcam.ros2._node.qos import PARAMETERS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from smartcam.ros2._node.interface import AnyPublisher, NodeOfRos
    from smartcam.ros2._node.parameter_values import Typed
    from smartcam.ros2._node.parameters import RosParameters

logger: logging.Logger = logging.getLogger("smartcam.ros2")

MAX_NAMES = 1024
"""Largest number of names in a request. One with more is refused: the answer to a list request is
empty, the answer to a set request has the reason."""

MAX_REASON_CHARACTERS = 1000
"""Largest number of characters of the reason why parameters could not be set."""

NAMES_PER_TURN = 64
"""Number of names after which the event loop runs other tasks."""

SEPARATOR: Final = "."
DEPTH_RECURSIVE: Final = 0


Answer = TypeVar("Answer")


class ParameterServices:
    """Serves a node's parameters to other nodes.

    Args:
        node: node that has the parameters.
        parameters: parameters to serve.
    """

    def __init__(self, node: NodeOfRos, parameters: RosParameters) -> None:
        self._node, self._parameters = node, parameters
        self._events: AnyPublisher | None = None

    def open(self) -> None:
        """Start to serve, and publish the current parameters."""
        self._events = self._node.publisher(
            "/parameter_events", "rcl_interfaces/msg/ParameterEvent", qos=PARAMETERS
        )
        for name, type, handler in (
            ("describe_parameters", "DescribeParameters", self._describe),
            ("get_parameter_types", "GetParameterTypes", self._get_types),
            ("get_parameters", "GetParameters", self._get),
            ("list_parameters", "ListParameters", self._list),
            ("set_parameters", "SetParameters", self._set),
            ("set_parameters_atomically", "SetParametersAtomically", self._set_atomically),
        ):
            self._node.serve(f"~/{name}", f"rcl_interfaces/srv/{type}", handler, qos=PARAMETERS)
        self.publish_event(new=self._parameters.names())

    def close(self) -> None:
        """Stop publishing; the node closes the endpoints."""
        self._events = None

    def publish_event(
        self,
        *,
        new: Sequence[str] = (),
        changed: Sequence[str] = (),
        deleted: Mapping[str, Typed] | None = None,
    ) -> None:
        """Publish that parameters are new, changed or deleted."""
        if self._events is None or not (new or changed or deleted):
            return
        seconds, nanoseconds = divmod(time.time_ns(), 1_000_000_000)
        self._events.publish(
            stamp={"sec": seconds, "nanosec": nanoseconds},
            node=self._node.full_name,
            new_parameters=self._messages(new),
            changed_parameters=self._messages(changed),
            deleted_parameters=[
                {"name": name, "value": encode_value(old_value)}
                for name, old_value in (deleted or {}).items()
            ],
        )

    def _messages(self, names: Iterable[str]) -> list[dict[str, Any]]:
        values = ((name, self._parameters.find(name)) for name in names)
        return [{"name": name, "value": encode_value(value)} for name, value in values if value]

    # ------------------------------------------------------------------ reading

    async def _describe(self, request: Any) -> dict[str, Any]:
        message_type = self._node.types.message("rcl_interfaces/msg/ParameterDescriptor")
        describe = self._parameters.describe
        return {
            "descriptors": await self._answer_each(
                request.names, lambda name, _: message_type.new(**describe(name).encode())
            )
        }

    async def _get_types(self, request: Any) -> dict[str, Any]:
        types = await self._answer_each(request.names, lambda _, value: value.type_number)
        return {"types": bytes(types)}

    async def _get(self, request: Any) -> dict[str, Any]:
        message_type = self._node.types.message("rcl_interfaces/msg/ParameterValue")
        return {
            "values": await self._answer_each(
                request.names, lambda _, value: message_type.new(**encode_value(value))
            )
        }

    async def _answer_each(
        self, names: Sequence[str], make: Callable[[str, Typed], Answer]
    ) -> list[Answer]:
        """Return an answer for each name; [] if a name is not declared, or there are too many."""
        if self._too_many_reason(names):
            return []
        answers = []
        for count, name in enumerate(names, 1):
            value = self._parameters.find(name)
            if value is None:
                return []
            answers.append(make(name, value))
            if not count % NAMES_PER_TURN:
                await asyncio.sleep(0)
        return answers

    async def _list(self, request: Any) -> dict[str, Any]:
        if self._too_many_reason(request.prefixes):
            return {}
        names: list[str] = []
        prefixes: dict[str, None] = {}
        for count, name in enumerate(self._parameters.names(), 1):
            if _is_listed(name, request.prefixes, request.depth):
                names.append(name)
                if SEPARATOR in name:
                    prefixes[name.rpartition(SEPARATOR)[0]] = None
            if not count % NAMES_PER_TURN:
                await asyncio.sleep(0)
        return {"result": {"names": names, "prefixes": list(prefixes)}}

    # ------------------------------------------------------------------ setting

    async def _set(self, request: Any) -> dict[str, Any]:
        if too_many := self._too_many_reason(request.parameters):
            refused = {"successful": False, "reason": too_many}
            return {"results": [refused] * len(request.parameters)}
        results = []
        for parameter in request.parameters:
            results.append(await self._set_result([parameter]))
            await asyncio.sleep(0)
        return {"results": results}

    async def _set_atomically(self, request: Any) -> dict[str, Any]:
        if too_many := self._too_many_reason(request.parameters):
            return {"result": {"successful": False, "reason": too_many}}
        if not request.parameters:
            return {"result": {"successful": False, "reason": "expected a parameter, got none"}}
        return {"result": await self._set_result(request.parameters)}

    def _too_many_reason(self, names: Sequence[Any]) -> str:
        """Return the reason to refuse too many names, and log it; "" if there are not too many."""
        if len(names) <= MAX_NAMES:
            return ""
        too_many = f"a request with {len(names)} names: expected {MAX_NAMES} at most"
        logger.warning("%s ! %s", self._node.full_name, too_many)
        return too_many

    async def _set_result(self, parameters: Sequence[Any]) -> dict[str, Any]:
        try:
            values = {parameter.name: decode_value(parameter.value) for parameter in parameters}
            await self._parameters.set_shielded(values)
        except SmartCamError as exc:
            return {"successful": False, "reason": reason_text(exc)}
        return {"successful": True}


def reason_text(exc: SmartCamError) -> str:
    """Return an error of setting parameters as a text that fits into a message."""
    text = "; ".join((str(exc), *getattr(exc, "__notes__", ())))
    return text[:MAX_REASON_CHARACTERS].replace("\0", " ").encode(errors="replace").decode()


def _is_listed(name: str, prefixes: Sequence[str], depth: int) -> bool:
    """Return True if a name is at most ``depth`` parts below a requested prefix."""
    for prefix in prefixes or ("",):
        if name == prefix:
            return True
        start = f"{prefix}{SEPARATOR}" if prefixes else ""
        if name.startswith(start) and (
            depth == DEPTH_RECURSIVE or name.count(SEPARATOR, len(start)) < depth
        ):
            return True
    return False
