"""Names behind the wall of the room that several of its tests use."""

from __future__ import annotations

from smartcam._client import handshake
from smartcam._client.correlation import (
    Correlation,
    Debt,
    EvidenceByAnswer,
    EvidenceByFence,
    EvidenceByStatus,
    Match,
    TriggerEvidence,
)
from smartcam._client.handshake import establish
from smartcam._client.link import Chunk, Link
from smartcam._client.results import PendingTrigger, Results

__all__ = [
    "Chunk",
    "Correlation",
    "Debt",
    "EvidenceByAnswer",
    "EvidenceByFence",
    "EvidenceByStatus",
    "Link",
    "Match",
    "PendingTrigger",
    "Results",
    "TriggerEvidence",
    "establish",
    "handshake",
]
