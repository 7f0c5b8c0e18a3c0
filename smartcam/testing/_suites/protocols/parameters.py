"""Run a suite's checks with each dialect, conversation or kind of camera, by its name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import pytest

from smartcam.protocols import Protocol, Transport
from smartcam.testing._suites.in_words import ExplainedChecks

if TYPE_CHECKING:
    from collections.abc import Sequence

    from smartcam.protocols import Dialect
    from smartcam.testing._suites.protocols.cameras_under_test import CameraKind
    from smartcam.testing._suites.protocols.conversations import Conversation


class SuiteBase(ExplainedChecks):
    """Base of the suites: the values that the author of a protocol gives.

    Attributes:
        protocol: the protocol of the entry point.
        conversations: bytes from the protocol's documents, at least one for each dialect.
        camera_kinds: cameras that speak the protocol.
    """

    protocol: ClassVar[Protocol]
    conversations: ClassVar[Sequence[Conversation]] = ()
    camera_kinds: ClassVar[Sequence[CameraKind]] = ()

    def pytest_generate_tests(self, metafunc: pytest.Metafunc) -> None:
        """Run a check with each value of its argument; pytest calls it.

        Raises:
            pytest.UsageError: ``protocol`` is not valid.
        """
        for name in ("dialect", "conversation", "stream", "camera_kind"):
            if name in metafunc.fixturenames:
                cases = self._cases_for(name)
                metafunc.parametrize(name, cases, ids=_label)

    def _cases_for(self, name: str) -> list[Any]:
        suite = type(self)
        if name == "camera_kind":
            return list(self.camera_kinds) or _skipped_case(
                f"{suite.__name__}.camera_kinds is empty"
            )
        if not isinstance(getattr(suite, "protocol", None), Protocol):
            raise pytest.UsageError(f"{suite.__name__}.protocol: expected a Protocol")
        if name == "dialect":
            return dialects_of(self.protocol)
        conversations = [
            conversation
            for conversation in self.conversations
            if name == "conversation" or conversation.transport is Transport.TCP
        ]
        return conversations or _skipped_case(
            f"{suite.__name__}.conversations has none"
            + (" over TCP" if name == "stream" and self.conversations else "")
        )


def _skipped_case(reason: str) -> list[Any]:
    return [pytest.param(None, id="none", marks=pytest.mark.skip(reason=reason))]


def _label(value: object) -> str | None:
    label = getattr(value, "label", None)
    return label if isinstance(label, str) else str(value)


def dialects_of(protocol: Protocol) -> list[Dialect]:
    """Return the dialects of a protocol, and their variants with quirks that a client tries."""
    dialects: list[Dialect] = list(protocol.dialects.values())
    groups = [group for tries in protocol.detection.values() for group in tries]
    for dialect in (each for group in groups for each in group):
        if dialect not in dialects:
            dialects.append(dialect)
    return dialects
