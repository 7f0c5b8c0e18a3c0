"""The suite for authors of protocols: subclass, name the protocol, inherit the tests.

::

    class TestAcme(ProtocolSuite):
        protocol = ACME
        conversations = [Conversation(name="a trigger", dialect="lines", steps=[...])]
        camera_kinds = [CameraKind(name="Acme", open=put_up)]

:class:`WireSuite` is the part that needs no camera, :class:`CameraSuite` the part that has a
client connected to one. They run with pytest, and need no plugin for asynchronous tests.
"""

from __future__ import annotations

import pytest

pytest.register_assert_rewrite(
    *(
        f"smartcam.testing._suites.protocols.{name}"
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
