"""Frames over links that are too thin for them: namespaces, cables, and ``tc`` between two hosts.

Bounds are those of a machine that is busy; ``python -m benchmarks.thin_links`` prints the figures.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
from collections.abc import Iterator

import pytest

from benchmarks.thin_links import PATIENCE, ThinLinks, fifo, one_on_request, plain, served, streamed

pytest.importorskip("zenoh")
pytest.importorskip("simplejpeg")

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def links() -> Iterator[ThinLinks]:
    for tool in ("ip", "tc"):
        if shutil.which(tool) is None:
            pytest.skip(f"there is no {tool}, which makes namespaces and shapes their links")
    with contextlib.ExitStack() as stack:
        try:
            made = stack.enter_context(ThinLinks())
            made.shape(100)
        except (OSError, subprocess.CalledProcessError) as exc:
            pytest.skip(f"no namespaces can be made here: {getattr(exc, 'stderr', exc)}")
        stack.enter_context(served(made))
        stack.enter_context(plain(made))
        yield made


def test_stream_is_as_late_as_one_frame_is_where_a_fifo_is_seconds_late(links: ThinLinks) -> None:
    links.shape(100)
    with fifo(links, 7.0) as queue:
        raw = streamed(links, "large", 6.0)
        out, _ = queue.communicate(timeout=PATIENCE)
    beside = json.loads(out)
    assert beside["p50"] > raw["p50"] > 0  # by how much: benchmarks.thin_links


@pytest.mark.widest
def test_one_frame_on_request_takes_little_more_than_its_encoding_and_way(links: ThinLinks) -> None:
    links.shape(100)
    found = one_on_request(links, 40)
    assert 3_000 < found["size"] < 20_000


@pytest.mark.widest
def test_bit_rate_is_held(links: ThinLinks) -> None:
    links.shape(20)
    found = streamed(links, "small", 8.0, encoding="jpeg", bitrate=3e6)
    assert found["why"].startswith("bit rate")
    assert 0 < found["bitrate"] <= 3.6e6


@pytest.mark.widest
def test_latency_is_held_where_the_link_is_thin(links: ThinLinks) -> None:
    links.shape(2)
    found = streamed(links, "small", 8.0, encoding="jpeg", latency=0.06)
    assert found["why"].startswith("latency")


def test_h264_crosses_a_link_that_no_picture_does(links: ThinLinks) -> None:
    pytest.importorskip("av")
    links.shape(4)
    found = streamed(links, "small", 6.0, encoding="h264", bitrate=1e6)
    assert found["fps"] > 0
