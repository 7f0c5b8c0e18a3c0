"""Another node's parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from smartcam.exceptions import ConfigurationError, ServiceCallError
from smartcam.ros2._node.parameter_values import (
    ParameterDescription,
    decode_value,
    encode_value,
    typed_value,
)
from smartcam.ros2._node.qos import PARAMETERS

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from typing import Self

    from smartcam.ros2._node.services import RosClient

CALL_TIMEOUT = 15.0
"""Seconds that a call may take; a node of smartcam takes up to ten to set a parameter."""


class ParameterClient:
    """Another node's parameters; created by :meth:`Node.parameters_of`, and closed with its node.

    Every method raises a :class:`~smartcam.ServiceCallError` if there is no such node, or the node
    does not answer. After a cancelled call the client is usable; whether a cancelled set is carried
    out is not known.

    Args:
        client: the method ``client`` of the calling node, which creates the client of a service.
        name: full name of the other node.
        timeout: seconds for one call.
    """

    def __init__(
        self, client: Callable[..., RosClient], name: str, timeout: float = CALL_TIMEOUT
    ) -> None:
        self.name: str = name
        self._client, self._timeout = client, timeout
        self._clients: dict[str, RosClient] = {}

    async def list(self, *prefixes: str, depth: int = 0) -> list[str]:
        """Return the names of parameters.

        Args:
            *prefixes: names of parameters, and of groups of them; default: all.
            depth: largest number of parts of a name below a prefix; 0 for any number.
        """
        reply = await self._call(
            "list_parameters", "ListParameters", prefixes=prefixes, depth=depth
        )
        return list(reply.result.names)

    async def get(self, *names: str) -> dict[str, Any]:
        """Return values by their names; arrays are tuples, and None means not set.

        Raises:
            ServiceCallError: one of the parameters is not declared there.
        """
        reply = await self._call("get_parameters", "GetParameters", names=names)
        self._check("get_parameters", names, reply.values)
        values = zip(names, reply.values, strict=True)
        return {name: decode_value(value).value for name, value in values}

    async def describe(self, *names: str) -> dict[str, ParameterDescription]:
        """Return the descriptions of parameters by their names.

        Raises:
            ServiceCallError: one of the parameters is not declared there.
        """
        reply = await self._call("describe_parameters", "DescribeParameters", names=names)
        self._check("describe_parameters", names, reply.descriptors)
        fields = zip(names, reply.descriptors, strict=True)
        return {name: ParameterDescription.decode(described) for name, described in fields}

    async def set(self, values: Mapping[str, object] | None = None, /, **more: object) -> None:
        """Set parameters, all or none.

        Args:
            values: values by the parameters' names; an ``int`` is not accepted for a double.
            **more: further values.

        Raises:
            ConfigurationError: a value cannot be a parameter.
            ServiceCallError: the node refused, with its reason.
        """
        all_values = {**(values or {}), **more}
        if not all_values:
            raise ConfigurationError(f"{self.name}: expected parameters to set, got none")
        reply = await self._call(
            "set_parameters_atomically",
            "SetParametersAtomically",
            parameters=[
                {"name": name, "value": encode_value(typed_value(name, value))}
                for name, value in all_values.items()
            ],
        )
        if not reply.result.successful:
            raise ServiceCallError(
                f"{self.name} refused to set {', '.join(all_values):.200}: "
                f"{reply.result.reason[:1000] or 'it does not say why'}",
                service=f"{self.name}/set_parameters_atomically",
            )

    async def _call(self, service: str, type: str, **fields: Any) -> Any:
        client = self._clients.get(service)
        if client is None:
            client = self._clients[service] = self._client(
                f"{self.name}/{service}", f"rcl_interfaces/srv/{type}", qos=PARAMETERS
            )
        return await client.call(timeout=self._timeout, **fields)

    def _check(self, service: str, names: Sequence[str], answers: Sequence[Any]) -> None:
        if len(answers) != len(names):
            raise ServiceCallError(
                f"{self.name}: {len(answers)} answers for {len(names)} names: not all of "
                f"{', '.join(names):.200} are declared there",
                service=f"{self.name}/{service}",
            )

    def close(self) -> None:
        """Close the clients of the services. Idempotent."""
        clients, self._clients = self._clients, {}
        for client in clients.values():
            client.close()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.close()
