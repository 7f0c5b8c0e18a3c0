"""The writer of MCAP, byte for byte as the mcap library's."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import pytest
import zstandard
from hypothesis import example, given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from smartcam.recording._mcap.writer import McapWriter

if TYPE_CHECKING:
    from collections.abc import Sequence

Call = tuple[Any, ...]

TIMES = st.integers(0, 2**63)
FACTS = st.dictionaries(st.text(max_size=3), st.text(max_size=5), max_size=3)
CALLS = st.lists(
    st.one_of(
        st.tuples(st.just("schema"), st.text(max_size=5), st.binary(max_size=40)),
        st.tuples(st.just("channel"), st.text(max_size=5), FACTS),
        st.tuples(st.just("message"), st.integers(0, 9), TIMES, st.binary(max_size=60)),
        st.tuples(st.just("metadata"), st.text(max_size=5), FACTS),
        st.tuples(st.just("flush")),
    ),
    max_size=25,
)


def by_library(calls: Sequence[Call], chunk: int) -> bytes:
    stream = io.BytesIO()
    writer: Any = Writer(stream, chunk_size=chunk)
    writer.start("x-test", library="test 1")
    channels = 0
    for number, (what, *given_) in enumerate(calls):
        match what, given_:
            case "schema", (name, data):
                writer.register_schema(name, "jsonschema", data)
            case "channel", (topic, facts):
                writer.register_channel(topic, "json", 0, facts)
                channels += 1
            case "message", (channel, at, data):
                if channels:
                    writer.add_message(channel % channels + 1, at, data, at, number)
            case "metadata", (name, facts):
                writer.add_metadata(name, facts)
            case _:
                writer.flush()
    writer.finish()
    return stream.getvalue()


def by_us(calls: Sequence[Call], chunk: int) -> bytes:
    stream = io.BytesIO()
    writer = McapWriter(stream, zstandard.compress, chunk)
    writer.start("x-test", "test 1")
    channels = 0
    for number, (what, *given_) in enumerate(calls):
        match what, given_:
            case "schema", (name, data):
                writer.register_schema(name, "jsonschema", data)
            case "channel", (topic, facts):
                channels = writer.register_channel(topic, "json", 0, facts)
            case "message", (channel, at, data):
                if channels:
                    writer.add_message(channel % channels + 1, at, data, number)
            case "metadata", (name, facts):
                writer.add_metadata(name, facts)
            case _:
                writer.flush()
    writer.finish()
    return stream.getvalue()


M = "message"
C: Call = ("channel", "a", {})


@given(CALLS, st.sampled_from([1, 100, 400, 1 << 20]))
@example([C, (M, 0, 5, b"x"), ("flush",), (M, 0, 3, b"y")], 1 << 20)  # back in time
@example([C, C, (M, 1, 5, b"x"), (M, 0, 7, b"y"), (M, 1, 6, b"z")], 1 << 20)
@example([C, ("flush",), (M, 0, 5, b""), ("flush",), ("flush",)], 1)
def test_writer_makes_the_bytes_that_the_library_makes(calls: list[Call], chunk: int) -> None:
    assert by_us(calls, chunk) == by_library(calls, chunk)


def test_writer_makes_what_the_library_reads_by_its_index() -> None:
    calls: list[Call] = [("schema", "S", b"{}"), C, ("channel", "b", {"camera": "b"})]
    calls += [(M, number % 2, 1000 - number, b"%d" % number) for number in range(200)]
    reader = make_reader(io.BytesIO(by_us(calls, 500)), validate_crcs=True)
    found = [(channel.topic, message.data) for _, channel, message in reader.iter_messages()]
    assert len(found) == 200
    assert found[0] == ("b", b"199")  # in the order of time, which only the index knows
    assert {data for topic, data in found if topic == "a"} == {b"%d" % n for n in range(0, 200, 2)}
    summary = reader.get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.channel_message_counts == {1: 100, 2: 100}
    assert len(summary.chunk_indexes) > 5


def test_writer_hands_on_what_the_disk_says() -> None:
    class Full(io.BytesIO):
        def write(self, data: Any, /) -> int:
            raise OSError(28, "No space left on device")

    writer = McapWriter(Full(), zstandard.compress, 10)
    with pytest.raises(OSError, match="No space"):
        writer.start("x-test", "test 1")
    channel = writer.register_channel("a", "json", 0, {})
    with pytest.raises(OSError, match="No space"):
        writer.add_message(channel, 1, bytes(100), 1)
