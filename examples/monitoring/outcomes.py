"""Count triggers by outcome for Prometheus, by an observer.

It needs ``pip install prometheus-client``.
"""

import asyncio

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

import smartcam
import smartcam.emulator


class TriggerMetrics(smartcam.Observer):
    def __init__(self, registry):
        self._outcomes = Counter(
            "smartcam_triggers", "Triggers by outcome", ["camera", "outcome"], registry=registry
        )
        self._seconds = Histogram(
            "smartcam_trigger_seconds",
            "From trigger to result",
            ["camera"],
            buckets=[0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5],
            registry=registry,
        )
        self._connected = Gauge(
            "smartcam_connected", "Whether there is a session", ["camera"], registry=registry
        )

    def on_state(self, event):
        match event:
            case smartcam.Connected() | smartcam.Reconnected():
                self._connected.labels(event.camera).set(1)
            case smartcam.Disconnected():
                self._connected.labels(event.camera).set(0)

    def on_result(self, result):
        if result.triggered_at is not None:
            self._outcomes.labels(result.camera, "result").inc()
            self._seconds.labels(result.camera).observe(result.latency)

    def on_error(self, camera, error, triggered_at):
        if triggered_at is not None:
            self._outcomes.labels(camera, type(error).__name__).inc()


async def main():
    registry = CollectorRegistry()
    async with smartcam.emulator.EmulatedCamera() as emulator:
        async with smartcam.connect(
            emulator.url, name="table", application=21, observers=[TriggerMetrics(registry)]
        ) as camera:
            for _ in range(3):
                await camera.trigger()
            await camera.stop()
            try:
                await camera.trigger()
            except smartcam.NotRunningError:
                pass
            lines = generate_latest(registry).decode().splitlines()

    assert 'smartcam_triggers_total{camera="table",outcome="result"} 3.0' in lines
    assert 'smartcam_triggers_total{camera="table",outcome="NotRunningError"} 1.0' in lines
    assert 'smartcam_trigger_seconds_bucket{camera="table",le="0.02"} 0.0' in lines
    assert 'smartcam_trigger_seconds_count{camera="table"} 3.0' in lines
    assert 'smartcam_connected{camera="table"} 1.0' in lines


asyncio.run(main())
