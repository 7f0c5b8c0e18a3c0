"""The suite for authors of protocols: subclass, say what the protocol is, inherit the tests.

::

    class TestAcme(ProtocolSuite):
        protocol = ACME
        conversations = [Conversation(name="a trigger", dialect="lines", steps=[...])]
        worlds = [World(name="Acme", open=put_up)]

:class:`WireSuite` is the part of it that needs no camera, :class:`CameraSuite` the one that has a
client in front of one. They run with pytest, and need no plugin for asynchronous tests.
"""

# ruff: noqa: E402 - assert statements of modules that are imported before are not rewritten

from __future__ import annotations

import pytest

pytest.register_assert_rewrite(
    *(
        f"smartcam.testing.suites.protocols.{name}"
        for name in (
            "client_checks",
            "dialects",
            "machines",
            "optional_features",
            "sessions",
            "triggers",
        )
    )
)

from smartcam.testing.suites.protocols.cameras_under_test import (
    COUNTER,
    ECHO,
    FREE,
    NOBODYS,
    OTHER,
    SLOW,
    SLOW_TIME,
    Site,
    World,
)
from smartcam.testing.suites.protocols.conversations import Came, Conversation, Sent
from smartcam.testing.suites.protocols.suite import CameraSuite, ProtocolSuite, WireSuite

__all__ = [
    "COUNTER",
    "ECHO",
    "FREE",
    "NOBODYS",
    "OTHER",
    "SLOW",
    "SLOW_TIME",
    "Came",
    "CameraSuite",
    "Conversation",
    "ProtocolSuite",
    "Sent",
    "Site",
    "WireSuite",
    "World",
]
