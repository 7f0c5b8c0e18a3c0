"""An agent's numbers as Prometheus has them. Nothing is counted for it: what is there is read.

The agent belongs to its event loop, so it is read there, a few cameras at a time; the text is made
in a thread, from what was read.
"""

from __future__ import annotations

import asyncio
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any, NamedTuple

from smartcam.exceptions import MissingExtraError
from smartcam.fleet._trigger_counts import RESULT, SUMS, Totals, cumulative

if TYPE_CHECKING:
    from collections.abc import Iterator

    from smartcam.fleet._host import Host
    from smartcam.fleet._server import FleetServer
    from smartcam.frames._source import SourceStatistics
    from smartcam.models import Histogram, Statistics

SLICE = 8
"""Cameras that are read at a time: a fraction of a millisecond."""

FATES = ("triggered", "streamed", "late", "wrong_application", "uninterpretable", "unclaimed")

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
    "unexpected_messages": ("smartcam_unexpected_messages", "Answers nobody waited for"),
    "long_bodies": ("smartcam_long_messages", "Messages longer than documented"),
}


class CameraNumbers(NamedTuple):
    """What is read of one camera."""

    name: str
    connected: bool
    account: Statistics
    triggers: dict[str, int]
    viewers: int
    frames: SourceStatistics | None


class AgentNumbers(NamedTuple):
    """What is read of an agent; ``gauges`` are of the moment."""

    agent: str
    fleet: str
    began: float
    gauges: dict[str, float]
    reloads: dict[str, int]
    reloaded: bool
    past: Totals
    cameras: list[CameraNumbers]


async def read_numbers(server: FleetServer) -> AgentNumbers | None:
    """Read an agent in its event loop, a few cameras at a time; None where it does not run."""
    agent = server.agent
    if agent is None:
        return None
    hosts = [*agent.hosts.values()]
    read: list[tuple[Host, CameraNumbers]] = []
    kept = kept_bytes = waiting = reserved = 0
    for begin in range(0, len(hosts), SLICE):
        for host in hosts[begin : begin + SLICE]:
            if agent.hosts.get(host.name) is host:  # it may be gone meanwhile
                read.append((host, _camera(host)))
                kept += host.results.kept
                kept_bytes += host.results.kept_bytes
                waiting += host.gate.waiting
                reserved += host.gate.holder is not None
        await asyncio.sleep(0)
    gauges: dict[str, float] = {
        "programs": agent.programs,
        "calls": agent.calls,
        "kept_results": kept,
        "kept_bytes": kept_bytes,
        "waiting_commands": waiting,
        "reserved": reserved,
        "bus_bytes": server.bus_bytes,
    }
    reloads = server.reloads
    # of one moment: each camera is counted once, here or among those that are gone
    cameras = [one for host, one in read if agent.hosts.get(host.name) is host]
    past = Totals(agent.past)
    past.add(host.camera.statistics() for host in agent.leaving)
    return AgentNumbers(
        agent.name,
        server.file.fleet,
        agent.epoch / 1e9,
        gauges,
        dict(reloads.outcomes),
        not isinstance(reloads.last, Exception),
        past,
        cameras,
    )


def _camera(host: Host) -> CameraNumbers:
    frames = host.frames
    return CameraNumbers(
        host.name,
        host.connected,
        host.camera.statistics(),
        dict(host.triggers),
        frames.viewers,
        frames.statistics,
    )


def exposition(numbers: AgentNumbers | None, *, each: bool) -> tuple[bytes, str]:
    """Return the text of an agent's numbers, and its content type; blocks for a while.

    Args:
        numbers: what was read.
        each: a histogram for each camera.

    Raises:
        MissingExtraError: prometheus-client is not installed.
    """
    client = _client()
    registry = client.CollectorRegistry(auto_describe=False)
    client.ProcessCollector(registry=registry)
    client.GCCollector(registry=registry)
    if numbers is not None:
        registry.register(FleetCollector(numbers, each=each))
    return client.generate_latest(registry), client.CONTENT_TYPE_LATEST


def require_client() -> None:
    """See that what makes the text is there.

    Raises:
        MissingExtraError: prometheus-client is not installed.
    """
    _client()


def _client() -> Any:
    try:
        import prometheus_client
        import prometheus_client.core
    except ModuleNotFoundError as exc:
        if exc.name != "prometheus_client":
            raise
        raise MissingExtraError(
            'metrics need prometheus-client: pip install "smartcam[operations]"',
            extra="operations",
        ) from exc
    return prometheus_client


class FleetCollector:
    """What was read of an agent, for a registry of prometheus-client.

    Args:
        numbers: what was read.
        each: a histogram for each camera.
    """

    def __init__(self, numbers: AgentNumbers, *, each: bool) -> None:
        self._numbers, self._each = numbers, each
        core = _client().core
        self._counter: Any = core.CounterMetricFamily
        self._gauge: Any = core.GaugeMetricFamily
        self._histogram: Any = core.HistogramMetricFamily
        self._summary: Any = core.SummaryMetricFamily
        self._info: Any = core.InfoMetricFamily

    def collect(self) -> Iterator[Any]:
        """Give all families."""
        yield from self._of_agent()
        yield from self._of_cameras()
        yield from self._of_frames()

    def _of_agent(self) -> Iterator[Any]:
        numbers = self._numbers
        own = [numbers.agent]
        info = self._info("smartcam_agent", "The agent of a fleet", labels=["agent"])
        info.add_metric(own, {"fleet": numbers.fleet, "version": _version()})
        yield info
        for name, key, text in _GAUGES:
            family = self._gauge(name, text, labels=["agent"])
            family.add_metric(own, numbers.gauges[key])
            yield family
        family = self._gauge("smartcam_agent_start_time_seconds", "When it began", labels=["agent"])
        family.add_metric(own, numbers.began)
        yield family
        family = self._gauge("smartcam_agent_cameras", "Cameras", labels=["agent", "state"])
        there = sum(one.connected for one in numbers.cameras)
        family.add_metric([*own, "connected"], there)
        family.add_metric([*own, "not_connected"], len(numbers.cameras) - there)
        yield family
        family = self._counter(
            "smartcam_reloads", "Readings of the fleet file", labels=["agent", "outcome"]
        )
        for outcome, count in numbers.reloads.items():
            family.add_metric([*own, outcome], count)
        yield family
        family = self._gauge(
            "smartcam_last_reload_successful",
            "Whether the last reading of the fleet file was taken",
            labels=["agent"],
        )
        family.add_metric(own, float(numbers.reloaded))
        yield family
        totals = Totals(numbers.past)
        totals.add(one.account for one in numbers.cameras)
        for key in SUMS:
            name, text = _SUMS[key]
            family = self._counter(name, text, labels=["agent"])
            family.add_metric(own, totals.counts[key])
            yield family
        yield self._latency(
            "smartcam_request_latency_seconds",
            "From a request to a camera to its answer",
            totals.round_trip,
        )
        yield self._latency(
            "smartcam_trigger_latency_seconds", "From a trigger to its result", totals.processing
        )

    def _latency(self, name: str, text: str, histogram: Histogram) -> Any:
        family = self._histogram(name, text, labels=["agent"])
        family.add_metric([self._numbers.agent], cumulative(histogram), histogram.total)
        return family

    def _of_cameras(self) -> Iterator[Any]:
        agent, cameras, labels = self._numbers.agent, self._numbers.cameras, ["agent", "camera"]
        family = self._gauge("smartcam_connected", "Whether there is a session", labels=labels)
        for one in cameras:
            family.add_metric([agent, one.name], float(one.connected))
        yield family
        family = self._counter("smartcam_sessions", "Sessions that were made", labels=labels)
        for one in cameras:
            family.add_metric([agent, one.name], one.account.sessions)
        yield family
        family = self._counter("smartcam_results", "Results by fate", labels=[*labels, "fate"])
        for one in cameras:
            for fate in FATES:
                family.add_metric([agent, one.name, fate], getattr(one.account, fate))
        yield family
        family = self._counter(
            "smartcam_triggers", "Triggers of programs by outcome", labels=[*labels, "outcome"]
        )
        for one in cameras:
            for outcome, count in {RESULT: 0, **one.triggers}.items():
                family.add_metric([agent, one.name, outcome], count)
        yield family
        name = "smartcam_camera_trigger_latency_seconds"
        text = "From a trigger to its result, of each camera"
        make = self._histogram if self._each else self._summary
        family = make(name, text, labels=labels)
        for one in cameras:
            times = one.account.processing
            if self._each:
                family.add_metric([agent, one.name], cumulative(times), times.total)
            else:
                family.add_metric([agent, one.name], times.count, times.total)
        yield family

    def _of_frames(self) -> Iterator[Any]:
        """Give what is of cameras whose frames somebody has looked at."""
        agent, labels = self._numbers.agent, ["agent", "camera"]
        found = [(one, one.frames) for one in self._numbers.cameras if one.frames is not None]
        viewers = self._gauge("smartcam_frame_viewers", "Streams of frames", labels=labels)
        came = self._counter("smartcam_frames", "Frames that came", labels=labels)
        lost = self._counter("smartcam_frames_lost", "Frames that never came", labels=labels)
        for one, frames in found:
            own = [agent, one.name]
            viewers.add_metric(own, one.viewers)
            came.add_metric(own, frames.frames)
            lost.add_metric(own, frames.lost)
        yield from (viewers, came, lost)


_GAUGES = (
    ("smartcam_agent_programs", "programs", "Programs that use its cameras"),
    ("smartcam_agent_calls_in_progress", "calls", "Calls of programs under way"),
    ("smartcam_agent_commands_waiting", "waiting_commands", "Commands that wait for a reservation"),
    ("smartcam_agent_reserved_cameras", "reserved", "Cameras that a program has reserved"),
    ("smartcam_agent_kept_results", "kept_results", "Results kept for programs that were cut off"),
    ("smartcam_agent_kept_results_bytes", "kept_bytes", "Their bytes"),
    ("smartcam_agent_bus_queue_bytes", "bus_bytes", "Bytes that wait to be said on the bus"),
)


def _version() -> str:
    try:
        return version("smartcam")
    except PackageNotFoundError:
        return "unknown"
