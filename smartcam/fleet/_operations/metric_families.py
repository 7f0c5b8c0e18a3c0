"""Convert an agent's numbers to Prometheus' families and their text.

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

    from smartcam.fleet._operations.metrics import AgentNumbers, CameraNumbers

MAX_LINES_PER_TURN = 80
"""Largest number of lines that are written in one step."""

_SUMS = {
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
    ("smartcam_agent_kept_results_bytes", "kept_bytes", "Their bytes"),
    ("smartcam_agent_bus_queue_bytes", "bus_bytes", "Bytes that wait to be sent on the bus"),
)


async def exposition(numbers: AgentNumbers | None, *, per_camera: bool) -> tuple[bytes, str]:
    """Return the text of an agent's numbers, and its content type.

    Args:
        numbers: the agent's numbers; None: the agent does not run.
        per_camera: whether there is a histogram for each camera.

    Raises:
        MissingExtraError: prometheus-client is not installed.
    """
    client = require_prometheus()
    parts: list[bytes] = [await asyncio.to_thread(_process_text, client)]
    if numbers is not None:
        for family in _agent_families(client.core, numbers):
            parts.append(_text(client, family))
            await asyncio.sleep(0)
        for kind in _KINDS if per_camera else (*_KINDS[:-1], _SUMMARY):
            cameras = [camera for camera in numbers.cameras if kind.applies(camera)]
            size = max(1, MAX_LINES_PER_TURN // kind.lines)
            for begin in range(0, len(cameras), size):
                family = kind.make_family(client.core, numbers.agent, cameras[begin : begin + size])
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


def _agent_families(core: Any, numbers: AgentNumbers) -> Iterator[Any]:
    values = [numbers.agent]
    family = core.InfoMetricFamily("smartcam_agent", "The agent of a fleet", labels=["agent"])
    family.add_metric(values, {"fleet": numbers.fleet, "version": _version()})
    yield family
    gauges = [(name, text, numbers.gauges[key]) for name, key, text in _GAUGES]
    gauges += [
        ("smartcam_agent_start_time_seconds", "When it began", numbers.started_at),
        (
            "smartcam_last_reload_successful",
            "Whether the last reading of the fleet file was taken",
            float(numbers.last_reload_succeeded),
        ),
    ]
    for name, text, value in gauges:
        family = core.GaugeMetricFamily(name, text, labels=["agent"])
        family.add_metric(values, value)
        yield family
    labels = ["agent", "state"]
    family = core.GaugeMetricFamily("smartcam_agent_cameras", "Cameras", labels=labels)
    connected = sum(camera.connected for camera in numbers.cameras)
    family.add_metric([*values, "connected"], connected)
    family.add_metric([*values, "not_connected"], len(numbers.cameras) - connected)
    yield family
    labels = ["agent", "outcome"]
    family = core.CounterMetricFamily("smartcam_reloads", "Readings of the file", labels=labels)
    for outcome, count in numbers.reloads.items():
        family.add_metric([*values, outcome], count)
    yield family
    yield from _outlet_families(core, numbers)
    for key in SUMS:
        name, text = _SUMS[key]
        family = core.CounterMetricFamily(name, text, labels=["agent"])
        family.add_metric(values, numbers.totals.counts[key])
        yield family
    for name, text, histogram in (
        (
            "smartcam_request_latency_seconds",
            "From a request to a camera to its answer",
            numbers.totals.round_trip,
        ),
        (
            "smartcam_trigger_latency_seconds",
            "From a trigger to its result",
            numbers.totals.processing,
        ),
    ):
        family = core.HistogramMetricFamily(name, text, labels=["agent"])
        family.add_metric(values, cumulative_bins(histogram), histogram.total)
        yield family


def _outlet_families(core: Any, numbers: AgentNumbers) -> Iterator[Any]:
    """Yield the families of outlets: each result was delivered, waits, or was dropped."""
    if not numbers.outlets:
        return
    labels = ["agent", "outlet"]
    received = core.CounterMetricFamily(
        "smartcam_outlet_results", "Results that came", labels=labels
    )
    delivered = core.CounterMetricFamily(
        "smartcam_outlet_delivered", "Results that the far end took", labels=labels
    )
    spooled = core.GaugeMetricFamily(
        "smartcam_outlet_spooled", "Results that wait for the far end", labels=labels
    )
    well = core.GaugeMetricFamily(
        "smartcam_outlet_up", "Whether nothing keeps results from the far end", labels=labels
    )
    dropped = core.CounterMetricFamily(
        "smartcam_outlet_dropped", "Results that were given up", labels=[*labels, "reason"]
    )
    for name, state in numbers.outlets.items():
        values, account = [numbers.agent, name], state.counts
        received.add_metric(values, account.results)
        delivered.add_metric(values, account.delivered)
        spooled.add_metric(values, account.spooled)
        well.add_metric(values, float(not state.trouble))
        for reason, count in account.dropped.items():
            dropped.add_metric([*values, reason], count)
    yield from (received, delivered, spooled, well, dropped)


# ---------------------------------------------------------------------- the cameras' families


class _MetricKind(NamedTuple):
    """A family with numbers of each camera.

    Attributes:
        type: type of the family, in the names of prometheus-client's classes.
        name: name of the family.
        text: help text of the family, for people.
        labels: names of the labels besides ``agent`` and ``camera``.
        values: function that returns a camera's labels, and the arguments of each number.
        lines: approximate number of lines for one camera.
        applies: function that returns whether a camera has numbers of the family.
    """

    type: str
    name: str
    text: str
    labels: tuple[str, ...]
    values: Callable[[CameraNumbers], list[tuple[tuple[str, ...], tuple[Any, ...]]]]
    lines: int
    applies: Callable[[CameraNumbers], bool] = lambda _: True

    def make_family(self, core: Any, agent: str, cameras: Sequence[CameraNumbers]) -> Any:
        """Return the family with the numbers of some cameras."""
        family_class = getattr(core, f"{self.type}MetricFamily")
        family = family_class(self.name, self.text, labels=["agent", "camera", *self.labels])
        for camera in cameras:
            for labels, number in self.values(camera):
                family.add_metric([agent, camera.name, *labels], *number)
        return family


def _has_frames(numbers: CameraNumbers) -> bool:
    return numbers.frames is not None


_LATENCY = ("smartcam_camera_trigger_latency_seconds", "From a trigger to its result, by camera")

_SUMMARY = _MetricKind(
    "Summary",
    *_LATENCY,
    (),
    lambda numbers: [((), (numbers.account.processing.count, numbers.account.processing.total))],
    2,
)

_KINDS = (
    _MetricKind(
        "Gauge",
        "smartcam_connected",
        "Whether there is a session",
        (),
        lambda numbers: [((), (float(numbers.connected),))],
        1,
    ),
    _MetricKind(
        "Gauge",
        "smartcam_taken",
        "Whether another client has the camera",
        (),
        lambda numbers: [((), (float(numbers.is_taken),))],
        1,
    ),
    _MetricKind(
        "Counter",
        "smartcam_sessions",
        "Sessions that were made",
        (),
        lambda numbers: [((), (numbers.account.sessions,))],
        1,
    ),
    _MetricKind(
        "Counter",
        "smartcam_results",
        "Results by fate",
        ("fate",),
        lambda numbers: [((fate,), (getattr(numbers.account, fate),)) for fate in FATES],
        6,
    ),
    _MetricKind(
        "Counter",
        "smartcam_triggers",
        "Triggers of programs by outcome",
        ("outcome",),
        lambda numbers: [((word,), (n,)) for word, n in {RESULT: 0, **numbers.triggers}.items()],
        3,
    ),
    _MetricKind(
        "Gauge",
        "smartcam_frame_viewers",
        "Streams of frames",
        (),
        lambda numbers: [((), (numbers.stream_count,))],
        1,
        _has_frames,
    ),
    _MetricKind(
        "Counter",
        "smartcam_frames",
        "Frames that came",
        (),
        lambda numbers: [((), (numbers.frames.frames if numbers.frames else 0,))],
        1,
        _has_frames,
    ),
    _MetricKind(
        "Counter",
        "smartcam_frames_lost",
        "Frames that never came",
        (),
        lambda numbers: [((), (numbers.frames.lost if numbers.frames else 0,))],
        1,
        _has_frames,
    ),
    _MetricKind(
        "Histogram",
        *_LATENCY,
        (),
        lambda numbers: [
            ((), (cumulative_bins(numbers.account.processing), numbers.account.processing.total))
        ],
        20,
    ),
)
"""Families with numbers of each camera; without ``per_camera`` a summary replaces the last
family."""


def _version() -> str:
    try:
        return version("smartcam")
    except PackageNotFoundError:
        return "unknown"
