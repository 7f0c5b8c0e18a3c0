"""Convert an agent's counts to Prometheus' families and their text.

To write the text for a thousand cameras takes a tenth of a second. A thread that writes it would
block the event loop for 5 ms at a time (Python's switch interval). So the event loop writes the
text itself, in steps of half a millisecond: one family of a few cameras in each step.
"""

from __future__ import annotations

import asyncio
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam._extras import load
from smartcam.fleet._operations.metrics import FATES
from smartcam.fleet._operations.trigger_counts import RESULT, SUMS, cumulative_bins

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from smartcam.fleet._operations.metrics import AgentCounts, CameraCounts
    from smartcam.models import Histogram

MAX_LINES_PER_TURN = 80
"""Largest number of lines that are written in one step."""

_SUM_TEXTS = {
    "bytes_received": ("smartcam_received_bytes", "Bytes from cameras"),
    "bytes_sent": ("smartcam_sent_bytes", "Bytes to cameras"),
    "frames_received": ("smartcam_received_messages", "Whole messages from cameras"),
    "frames_sent": ("smartcam_sent_messages", "Messages to cameras"),
    "overtriggers": ("smartcam_overtriggers", "Times that a camera reported Overtriggered"),
    "empty_slots": ("smartcam_empty_slots", "All-zero records that were skipped"),
    "extra_results": ("smartcam_extra_results", "Results beyond those that a trigger expected"),
    "inspections_by_others": (
        "smartcam_inspections_by_others",
        "Inspections that something else than the agent triggered",
    ),
    "ignored_datagrams": ("smartcam_ignored_datagrams", "Datagrams that were dropped"),
    "unknown_ids": ("smartcam_unknown_messages", "Messages of an unknown kind"),
    "unexpected_messages": ("smartcam_unexpected_messages", "Answers that no call waited for"),
    "long_bodies": ("smartcam_long_messages", "Messages longer than documented"),
}

_GAUGES = (
    ("smartcam_agent_programs", "programs", "Programs that use its cameras"),
    ("smartcam_agent_calls_in_progress", "calls", "Calls of programs under way"),
    ("smartcam_agent_commands_waiting", "waiting_commands", "Commands that wait for a reservation"),
    ("smartcam_agent_reserved_cameras", "reserved", "Cameras that a program has reserved"),
    ("smartcam_agent_kept_results", "kept_results", "Results kept for programs that were cut off"),
    ("smartcam_agent_kept_results_bytes", "kept_bytes", "Bytes of the kept results"),
    ("smartcam_agent_bus_queue_bytes", "bus_bytes", "Bytes that wait to be sent on the bus"),
)


async def exposition(counts: AgentCounts | None, *, per_camera: bool) -> tuple[bytes, str]:
    """Return the text of an agent's counts, and its content type.

    Args:
        counts: the agent's counts; None: the agent does not run.
        per_camera: whether there is a histogram for each camera.

    Raises:
        MissingExtraError: prometheus-client is not installed.
    """
    client = require_prometheus()
    parts: list[bytes] = [await asyncio.to_thread(_process_text, client)]
    if counts is not None:
        for family in _agent_families(client.core, counts):
            parts.append(_text(client, family))
            await asyncio.sleep(0)
        for kind in _KINDS if per_camera else (*_KINDS[:-1], _SUMMARY):
            cameras = [camera for camera in counts.cameras if kind.applies(camera)]
            size = max(1, MAX_LINES_PER_TURN // kind.lines)
            for begin in range(0, len(cameras), size):
                family = kind.make_family(client.core, counts.agent, cameras[begin : begin + size])
                text = _text(client, family)
                # only the first part of a family begins with the help text
                parts.append(text.split(b"\n", 2)[2] if begin else text)
                await asyncio.sleep(0)
    return b"".join(parts), client.CONTENT_TYPE_LATEST


def require_prometheus() -> Any:
    """Return prometheus-client.

    Raises:
        MissingExtraError: the package is not installed.
    """
    load("prometheus_client.core")
    return load("prometheus_client")


class _FamilyCollector(NamedTuple):
    """A collector of one family, which prometheus-client converts to text."""

    family: Any

    def collect(self) -> list[Any]:
        return [self.family]


def _text(client: Any, family: Any) -> bytes:
    text: bytes = client.generate_latest(_FamilyCollector(family))
    return text


def _process_text(client: Any) -> bytes:
    """Return the text of the process' families; blocks, since it asks the system for them."""
    registry = client.CollectorRegistry(auto_describe=False)
    client.ProcessCollector(registry=registry)
    client.GCCollector(registry=registry)
    text: bytes = client.generate_latest(registry)
    return text


# ---------------------------------------------------------------------- the agent's families


def _agent_families(core: Any, counts: AgentCounts) -> Iterator[Any]:
    agent_label = [counts.agent]
    family = core.InfoMetricFamily("smartcam_agent", "The agent of a fleet", labels=["agent"])
    family.add_metric(agent_label, {"fleet": counts.fleet, "version": _version()})
    yield family
    gauges = [(name, text, counts.gauges[key]) for name, key, text in _GAUGES]
    gauges += [
        ("smartcam_agent_start_time_seconds", "When it began", counts.started_at),
        (
            "smartcam_last_reload_successful",
            "Whether the last reload of the fleet file was accepted",
            float(counts.last_reload_succeeded),
        ),
    ]
    for name, text, value in gauges:
        family = core.GaugeMetricFamily(name, text, labels=["agent"])
        family.add_metric(agent_label, value)
        yield family
    labels = ["agent", "state"]
    family = core.GaugeMetricFamily("smartcam_agent_cameras", "Cameras", labels=labels)
    connected = sum(camera.connected for camera in counts.cameras)
    family.add_metric([*agent_label, "connected"], connected)
    family.add_metric([*agent_label, "not_connected"], len(counts.cameras) - connected)
    yield family
    labels = ["agent", "outcome"]
    text = "Reloads of the fleet file"
    family = core.CounterMetricFamily("smartcam_reloads", text, labels=labels)
    for outcome, count in counts.reloads.items():
        family.add_metric([*agent_label, outcome], count)
    yield family
    yield from _outlet_families(core, counts)
    for key in SUMS:
        name, text = _SUM_TEXTS[key]
        family = core.CounterMetricFamily(name, text, labels=["agent"])
        family.add_metric(agent_label, counts.totals.counts[key])
        yield family
    for name, text, histogram in (
        (
            "smartcam_request_latency_seconds",
            "From a request to a camera to its answer",
            counts.totals.round_trip,
        ),
        (
            "smartcam_trigger_latency_seconds",
            "From a trigger to its result",
            counts.totals.processing,
        ),
    ):
        family = core.HistogramMetricFamily(name, text, labels=["agent"])
        family.add_metric(agent_label, cumulative_bins(histogram), histogram.total)
        yield family


def _outlet_families(core: Any, counts: AgentCounts) -> Iterator[Any]:
    """Yield the families of outlets: each result was delivered, waits, or was dropped."""
    if not counts.outlets:
        return
    labels = ["agent", "outlet"]
    received = core.CounterMetricFamily(
        "smartcam_outlet_results", "Results that came", labels=labels
    )
    delivered = core.CounterMetricFamily(
        "smartcam_outlet_delivered", "Results that the far end accepted", labels=labels
    )
    spooled = core.GaugeMetricFamily(
        "smartcam_outlet_spooled", "Results that wait for the far end", labels=labels
    )
    is_up = core.GaugeMetricFamily(
        "smartcam_outlet_up", "Whether the outlet delivers its results", labels=labels
    )
    dropped = core.CounterMetricFamily(
        "smartcam_outlet_dropped", "Results that were given up", labels=[*labels, "reason"]
    )
    for name, state in counts.outlets.items():
        label_values, counts_of_outlet = [counts.agent, name], state.counts
        received.add_metric(label_values, counts_of_outlet.results)
        delivered.add_metric(label_values, counts_of_outlet.delivered)
        spooled.add_metric(label_values, counts_of_outlet.spooled)
        is_up.add_metric(label_values, float(not state.trouble))
        for reason, count in counts_of_outlet.dropped.items():
            dropped.add_metric([*label_values, reason], count)
    yield from (received, delivered, spooled, is_up, dropped)


# ---------------------------------------------------------------------- the cameras' families


class _MetricKind(NamedTuple):
    """A family with counts of each camera.

    Attributes:
        type: type of the family, in the names of prometheus-client's classes.
        name: name of the family.
        text: help text of the family, for people.
        labels: names of the labels besides ``agent`` and ``camera``.
        values: function that returns further label values of a camera, and the arguments of
            ``add_metric`` for each of them.
        lines: approximate number of lines for one camera.
        applies: function that returns whether a camera has counts of the family.
    """

    type: str
    name: str
    text: str
    labels: tuple[str, ...]
    values: Callable[[CameraCounts], list[tuple[tuple[str, ...], tuple[Any, ...]]]]
    lines: int
    applies: Callable[[CameraCounts], bool] = lambda _: True

    def make_family(self, core: Any, agent: str, cameras: Sequence[CameraCounts]) -> Any:
        """Return the family with the counts of some cameras."""
        family_class = getattr(core, f"{self.type}MetricFamily")
        family = family_class(self.name, self.text, labels=["agent", "camera", *self.labels])
        for camera in cameras:
            for labels, number in self.values(camera):
                family.add_metric([agent, camera.name, *labels], *number)
        return family


def _bins_and_total(histogram: Histogram) -> tuple[Any, float]:
    return cumulative_bins(histogram), histogram.total


def _has_frames(counts: CameraCounts) -> bool:
    return counts.frames is not None


_LATENCY = ("smartcam_camera_trigger_latency_seconds", "From a trigger to its result, by camera")

_SUMMARY = _MetricKind(
    "Summary",
    *_LATENCY,
    (),
    lambda counts: [((), (counts.statistics.processing.count, counts.statistics.processing.total))],
    2,
)

_KINDS = (
    _MetricKind(
        "Gauge",
        "smartcam_connected",
        "Whether there is a session",
        (),
        lambda counts: [((), (float(counts.connected),))],
        1,
    ),
    _MetricKind(
        "Gauge",
        "smartcam_taken",
        "Whether another client has the camera",
        (),
        lambda counts: [((), (float(counts.is_taken),))],
        1,
    ),
    _MetricKind(
        "Counter",
        "smartcam_sessions",
        "Sessions that were made",
        (),
        lambda counts: [((), (counts.statistics.sessions,))],
        1,
    ),
    _MetricKind(
        "Counter",
        "smartcam_results",
        "Results by fate",
        ("fate",),
        lambda counts: [((fate,), (getattr(counts.statistics, fate),)) for fate in FATES],
        6,
    ),
    _MetricKind(
        "Counter",
        "smartcam_triggers",
        "Triggers of programs by outcome",
        ("outcome",),
        lambda counts: [((word,), (n,)) for word, n in {RESULT: 0, **counts.triggers}.items()],
        3,
    ),
    _MetricKind(
        "Gauge",
        "smartcam_frame_streams",
        "Streams of frames",
        (),
        lambda counts: [((), (counts.stream_count,))],
        1,
        _has_frames,
    ),
    _MetricKind(
        "Counter",
        "smartcam_frames",
        "Frames that came",
        (),
        lambda counts: [((), (counts.frames.frames if counts.frames else 0,))],
        1,
        _has_frames,
    ),
    _MetricKind(
        "Counter",
        "smartcam_frames_lost",
        "Frames that never came",
        (),
        lambda counts: [((), (counts.frames.lost if counts.frames else 0,))],
        1,
        _has_frames,
    ),
    _MetricKind(
        "Histogram",
        *_LATENCY,
        (),
        lambda counts: [((), _bins_and_total(counts.statistics.processing))],
        20,
    ),
)
"""Families with counts of each camera; without ``per_camera`` a summary replaces the last
family."""


def _version() -> str:
    try:
        return version("smartcam")
    except PackageNotFoundError:
        return "unknown"
