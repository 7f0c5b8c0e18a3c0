"""Make an OpenTelemetry span of each trigger.

It needs ``pip install opentelemetry-sdk``. The exporter here keeps the spans in memory, so that the
example can check them; yours sends them through a ``BatchSpanProcessor``.
"""

import asyncio
from datetime import UTC, datetime, timedelta

from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from opentelemetry.trace import SpanKind, StatusCode

import smartcam
import smartcam.emulator

EPOCH = datetime.fromtimestamp(0, UTC)


def nanoseconds(when):
    return (when - EPOCH) // timedelta(microseconds=1) * 1000


class TriggerSpans(smartcam.Observer):
    def __init__(self, tracer):
        self._tracer = tracer

    def on_result(self, result):
        if result.triggered_at is None:
            return  # the trigger of a sensor, or a free run
        start = nanoseconds(result.triggered_at)
        span = self._start(result.camera, start)
        span.set_attribute("smartcam.application", result.application)
        span.set_attribute("smartcam.result", result.number)
        span.end(start + round(result.latency * 1e9))

    def on_error(self, camera, error, triggered_at):
        if triggered_at is None:
            return  # not the end of a trigger
        span = self._start(camera, nanoseconds(triggered_at))
        span.set_status(StatusCode.ERROR, str(error))
        span.record_exception(error)
        span.end()

    def _start(self, camera, start):
        return self._tracer.start_span(
            "smartcam.trigger",
            kind=SpanKind.CLIENT,
            start_time=start,
            attributes={"smartcam.camera": camera},
        )


async def main():
    exporter = InMemorySpanExporter()
    provider = TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    spans = TriggerSpans(provider.get_tracer("smartcam"))

    slow = {"id": 5, "layout": "n: int32", "constant": [1], "processing_time": 5}
    async with smartcam.emulator.EmulatedCamera([slow]) as emulator:
        async with smartcam.connect(
            emulator.url, name="table", application=21, observers=[spans]
        ) as camera:
            before = nanoseconds(datetime.now(UTC))
            result = await camera.trigger()
            await camera.switch_application(5)
            try:
                await camera.trigger(timeout=0.05)
            except smartcam.TriggerTimeoutError:
                pass
    provider.shutdown()

    good, failed = exporter.get_finished_spans()
    assert before <= good.start_time == nanoseconds(result.triggered_at)
    assert good.end_time - good.start_time == round(result.latency * 1e9)
    assert good.status.status_code is StatusCode.UNSET  # OpenTelemetry's word for no error
    assert good.attributes["smartcam.application"] == 21

    assert failed.status.status_code is StatusCode.ERROR
    assert "no result within" in failed.status.description
    assert failed.events[0].attributes["exception.type"].endswith("TriggerTimeoutError")
    assert failed.end_time - failed.start_time >= 50_000_000


asyncio.run(main())
