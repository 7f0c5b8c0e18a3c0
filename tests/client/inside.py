"""Names behind the wall of the room that its kits or several of its tests use."""

from __future__ import annotations

from smartcam._client import handshake, link, polling
from smartcam._client.connection import Connection
from smartcam._client.correlation import (
    Correlation,
    EvidenceByAnswer,
    EvidenceByRoundTrip,
    EvidenceByStatus,
    Match,
    OwedFate,
    SentTrigger,
    TriggerEvidence,
    _Owed,
)
from smartcam._client.dispatch import Dispatch
from smartcam._client.doorbell import DirectFuture, Doorbell, wait_ended
from smartcam._client.handshake import establish
from smartcam._client.link import MAX_CHUNK_FRAMES, Chunk, Link, LinksOfLoop, open_link, split_chunk
from smartcam._client.requests import Requests
from smartcam._client.results import PendingTrigger, Results
from smartcam._client.triggering import TRIGGER_BETWEEN_QUERIES, TriggerRequest
from smartcam._client.waits import StatusWaiter, Waits
