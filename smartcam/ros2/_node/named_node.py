"""A node of ROS with a name, for any transport."""

from __future__ import annotations

from abc import abstractmethod

from smartcam._ros_names import check_namespace, check_node, full_name, resolve
from smartcam._server import Server
from smartcam.exceptions import RosError

HANDLER_TIMEOUT = 600.0
"""Seconds that a service's handler may take."""


class NamedNode(Server):
    """A node of ROS that is opened and closed.

    Args:
        name: name of the node, of letters, digits and ``_``.
        namespace: namespace of the node, such as ``/line1``.

    Raises:
        ConfigurationError: name or namespace is not valid.
    """

    def __init__(self, name: str, namespace: str) -> None:
        self.name: str = check_node(name)
        self.namespace: str = check_namespace(namespace)

    @property
    def full_name(self) -> str:
        """The absolute name of the node, such as ``/line1/cam3``."""
        return full_name(self.namespace, self.name)

    @property
    @abstractmethod
    def is_open(self) -> bool:
        """True from the end of ``start()`` until ``stop()``."""

    def check_open(self) -> None:
        """Do nothing while the node is open.

        Raises:
            RosError: the node is not open.
        """
        if not self.is_open:
            raise RosError(f"{self.full_name}: the node is not open")

    def _resolve_name(self, name: str, kind_text: str) -> str:
        """Return the absolute name of a topic or a service of the open node.

        Args:
            name: name that is absolute, relative to the namespace, or private (``~/it``).
            kind_text: kind of the thing named, for error texts.

        Raises:
            ConfigurationError: the name is not valid.
            RosError: the node is not open.
        """
        absolute_name = resolve(name, self.namespace, self.name, kind_text)
        self.check_open()
        return absolute_name
