"""Check and resolve names of ROS nodes, topics and services.

The rules are those of ROS 2's design article "Topic and Service name mapping".
"""

from __future__ import annotations

import re

from smartcam.exceptions import ConfigurationError

MAX_NAME_CHARACTERS = 200
"""Largest number of characters of a name."""

_WORD = r"(?!.*__)[A-Za-z_][A-Za-z0-9_]*"
_NODE = re.compile(_WORD)
_NAME = re.compile(r"(~$|~/|/)?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*|~")
_NOT_ALLOWED = re.compile(r"[^A-Za-z0-9_/]")


def check_node(name: str) -> str:
    """Return the name of a node.

    Raises:
        ConfigurationError: the name is not valid.
    """
    if len(name) > MAX_NAME_CHARACTERS or not _NODE.fullmatch(name):
        raise ConfigurationError(
            f"ROS node {name!r:.120}: expected letters, digits and _, not beginning with a digit, "
            "without __"
        )
    return name


def check_namespace(namespace: str) -> str:
    """Return a namespace as ``/`` or ``/line1/cell2``; ``line1`` is ``/line1``.

    Raises:
        ConfigurationError: the namespace is not valid.
    """
    text = "/" + namespace.strip("/")
    return "/" if text == "/" else _check_name(text, "namespace")


def check_domain(domain: int) -> int:
    """Return a domain's number.

    Raises:
        ConfigurationError: the number is not valid.
    """
    if not 0 <= domain <= 0xFFFFFFFF:
        raise ConfigurationError(f"ROS domain {domain}: expected 0 or more")
    return domain


def full_name(namespace: str, node: str) -> str:
    """Return a node's full name, such as ``/line1/cam3``."""
    return f"{namespace.rstrip('/')}/{node}"


def resolve(name: str, namespace: str, node: str, kind: str = "topic") -> str:
    """Return the absolute name of a topic or a service.

    Args:
        name: absolute (``/a/b``), relative to the namespace (``a/b``) or private to the node
            (``~/a``).
        namespace: namespace of the node.
        node: name of the node.
        kind: what the name is for, "topic" or "service", for error texts.

    Raises:
        ConfigurationError: the name is not valid.
    """
    checked = _check_name(name, kind)
    if checked.startswith("/"):
        return checked
    if checked.startswith("~"):
        return full_name(namespace, node) + checked[1:]
    return f"{namespace.rstrip('/')}/{checked}"


def as_name(text: str) -> str:
    """Return the name in ROS for a name in smartcam: ``line_1/cam3`` for ``line-1/cam3``.

    Characters that ROS does not allow become ``_``; ``_`` is put before a part's leading digit.
    """
    parts = [_NOT_ALLOWED.sub("_", part) for part in text.strip("/").split("/")]
    parts = [re.sub("__+", "_", part) for part in parts]
    return "/".join(f"_{part}" if part[:1].isdigit() else part for part in parts)


def _check_name(name: str, kind: str) -> str:
    if len(name) > MAX_NAME_CHARACTERS or not _NAME.fullmatch(name) or "__" in name:
        raise ConfigurationError(
            f"ROS {kind} {name!r:.120}: expected parts of letters, digits and _ joined by /, none "
            "beginning with a digit, without __"
        )
    return name
