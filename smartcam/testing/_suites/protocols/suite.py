"""The suites that authors of protocols subclass."""

from __future__ import annotations

from smartcam.testing._suites.protocols.dialects import DialectChecks
from smartcam.testing._suites.protocols.machines import MachineChecks
from smartcam.testing._suites.protocols.optional_features import OptionalFeatureChecks
from smartcam.testing._suites.protocols.sessions import SessionChecks
from smartcam.testing._suites.protocols.triggers import TriggerChecks


class WireSuite(DialectChecks, MachineChecks):
    """Checks of a protocol's dialects and state machine, without a camera.

    A subclass has ``protocol``, which must be installed, and ``conversations``: at least one for
    each dialect, with the bytes of the protocol's documents.
    """


class CameraSuite(SessionChecks, TriggerChecks, OptionalFeatureChecks):
    """The checks of a client connected to any camera.

    A subclass has ``camera_kinds``, emulated or real cameras. A feature that a camera lacks in its
    dialect must be an UnsupportedError, and the session must continue.
    """


class ProtocolSuite(WireSuite, CameraSuite):
    """Both suites: a subclass has ``protocol``, ``conversations`` and ``camera_kinds``."""
