"""Give a client's counters to Prometheus on request, by a collector.

It needs ``pip install prometheus-client``. Prometheus' server asks in a thread of its own, and the
client belongs to the event loop, so the collector goes through the loop.
"""

import asyncio
import urllib.request

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, HistogramMetricFamily
from prometheus_client.registry import Collector

import smartcam
import smartcam.emulator

FATES = ["triggered", "streamed", "late", "wrong_application", "uninterpretable", "unclaimed"]


class AccountCollector(Collector):
    def __init__(self, *cameras):
        self._cameras = cameras
        self._loop = asyncio.get_running_loop()

    async def _read(self):
        return {camera.name: camera.statistics() for camera in self._cameras}

    def collect(self):
        accounts = asyncio.run_coroutine_threadsafe(self._read(), self._loop).result(timeout=5)
        results = CounterMetricFamily(
            "smartcam_results", "Result containers by fate", labels=["camera", "fate"]
        )
        reconnects = CounterMetricFamily(
            "smartcam_reconnects", "Sessions after the first", labels=["camera"]
        )
        seconds = HistogramMetricFamily(
            "smartcam_processing_seconds", "From trigger to result", labels=["camera"]
        )
        for name, account in accounts.items():
            for fate in FATES:
                results.add_metric([name, fate], getattr(account, fate))
            reconnects.add_metric([name], account.reconnects)
            seconds.add_metric([name], cumulative(account.processing), account.processing.total)
        return [results, reconnects, seconds]


def cumulative(histogram):
    """Return Prometheus' buckets: each counts all values up to its bound."""
    bounds = [*map(str, histogram.bounds), "+Inf"]
    return [(bound, sum(histogram.counts[: n + 1])) for n, bound in enumerate(bounds)]


def scrape(port):
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5) as answer:
        return answer.read().decode().splitlines()


async def main():
    registry = CollectorRegistry()
    server, thread = start_http_server(0, addr="127.0.0.1", registry=registry)
    async with smartcam.emulator.EmulatedCamera() as emulator:
        async with smartcam.connect(emulator.url, name="table", application=21) as camera:
            registry.register(AccountCollector(camera))
            await camera.trigger()

            waiting = camera.next_result()
            emulator.device.trigger()  # like a sensor's trigger; the subscriber gets the result
            await waiting

            lines = await asyncio.to_thread(scrape, server.server_port)
            account = camera.statistics()
    await asyncio.to_thread(server.shutdown)
    server.server_close()
    thread.join()

    assert 'smartcam_results_total{camera="table",fate="triggered"} 1.0' in lines
    assert 'smartcam_results_total{camera="table",fate="streamed"} 1.0' in lines
    assert 'smartcam_results_total{camera="table",fate="late"} 0.0' in lines
    assert 'smartcam_reconnects_total{camera="table"} 0.0' in lines
    assert 'smartcam_processing_seconds_bucket{camera="table",le="+Inf"} 1.0' in lines
    assert account.received == sum(getattr(account, fate) for fate in FATES) == 2


asyncio.run(main())
