"""A result's bytes are in the file once, in its frame, and are read from there."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any
from unittest import mock

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader

from smartcam.emulator import EmulatedCamera
from smartcam.models import Result
from smartcam.observers import TraceEntry
from smartcam.recording import Recorder, load_recording
from smartcam.recording._mcap import bodies as _bodies
from smartcam.recording._mcap.bodies import LastBodies
from tests.recording.inside import KINDS
from tests.recording.recordingkit import COUNTER, at, containers, record

if TYPE_CHECKING:
    from collections.abc import Iterable

    from tests.recording.inside import Item

CAMERAS = ("left", "right")


def came(camera: str, data: bytes, direction: str = "<") -> TraceEntry:
    """Return a frame with data at its end."""
    body = {"application": 5, "data": data.hex()}
    head = "20000000"
    return TraceEntry(at(0), camera, direction, 32, "ResultContainer", body, head + data.hex())


def result(camera: str, raw: bytes, value: Any = None) -> Result[Any]:
    return Result(camera, 5, None, 1, None, at(0), None, raw, value)


def messages(path: Path, topic: str) -> list[dict[str, Any]]:
    """Return what stands in a file, as the mcap library reads it."""
    with path.open("rb") as stream:
        return [json.loads(one.data) for _, _, one in make_reader(stream).iter_messages([topic])]


def record_items(path: Path, items: Iterable[Item]) -> None:
    with Recorder(path) as recorder:
        for item in items:
            if isinstance(item, TraceEntry):
                recorder.on_frame(item)
            elif isinstance(item, Result):
                recorder.on_result(item)


# ---------------------------------------------------------------------- what is kept


def test_last_bodies_are_known_within_the_bounds() -> None:
    with mock.patch.multiple(_bodies, MAX_FRAMES=3, MAX_CHARACTERS=10):
        known: LastBodies[str, int] = LastBodies()
        for number, key in enumerate("abcd"):
            known.add(key, number, 2)
        assert [known.get(key) for key in "abcd"] == [None, 1, 2, 3]
        known.add("e", 4, 9)
        assert [known.get(key) for key in "bcde"] == [None, None, None, 4]
        known.add("f", 5, 1 << 20)  # the last one is kept whatever it has
        assert [known.get(key) for key in "ef"] == [None, 5]


def test_last_bodies_know_the_later_of_two_that_are_equal() -> None:
    with mock.patch.multiple(_bodies, MAX_FRAMES=2):
        known: LastBodies[str, int] = LastBodies()
        for number, key in enumerate("aab"):
            known.add(key, number, 1)
        assert known.get("a") == 1
        known.add("c", 3, 1)
        assert known.get("a") is None


# ---------------------------------------------------------------------- in a file

DATA = st.sampled_from([b"", b"\x00", b"ab", b"abab", bytes(40), bytes(range(200))])
ITEMS = st.lists(
    st.one_of(
        st.builds(came, st.sampled_from(CAMERAS), DATA, st.sampled_from("<<<>!")),
        st.builds(result, st.sampled_from(CAMERAS), DATA),
        st.builds(lambda camera, raw: result(camera, raw, raw), st.sampled_from(CAMERAS), DATA),
    ),
    max_size=30,
)


@given(ITEMS, st.integers(1, 5), st.integers(1, 500))
def test_what_is_recorded_is_read_again(items: list[Any], frames: int, characters: int) -> None:
    expected = [
        one._replace(value=one.raw.hex()) if isinstance(one, Result) and one.value else one
        for one in items
    ]
    with TemporaryDirectory() as folder, ExitStack() as stack:
        stack.enter_context(
            mock.patch.multiple(_bodies, MAX_FRAMES=frames, MAX_CHARACTERS=characters)
        )
        path = Path(folder, "run.mcap")
        record_items(path, items)
        assert [*load_recording(path).items()] == [
            one._replace(value="") if isinstance(one, Result) and one.value == b"" else one
            for one in expected
        ]


def test_each_result_of_a_burst_is_in_its_own_frame(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    data = [number.to_bytes(2, "little") for number in range(500)]
    record_items(
        path, [*(came("left", one) for one in data), *(result("left", one) for one in data)]
    )
    written = messages(path, "/left/results")
    assert [one["raw_from"] for one in written] == [*range(1, 501)]
    assert not any("raw" in one for one in written)
    assert [one.raw for one in load_recording(path).results()] == data


def test_another_cameras_frame_is_not_it(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    record_items(path, [came("right", b"ab"), result("left", b"ab"), came("left", b"ab", ">")])
    (written,) = messages(path, "/left/results")
    assert (written["raw"], "raw_from" in written) == (b"ab".hex(), False)


async def test_no_byte_of_a_camera_stands_twice(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    text = {**COUNTER, "layout": "n: int32, text: string[40]"}
    async with EmulatedCamera([text]) as emulator:
        recording = await record(path, emulator, triggers=5)
    for one, (_, data) in zip(recording.results(), containers(recording), strict=True):
        assert (one.raw.hex(), one.value) == (data, data)
        with path.open("rb") as stream:
            found = [message.data.decode() for *_, message in make_reader(stream).iter_messages()]
        assert sum(message.count(data) for message in found) == 1


# ---------------------------------------------------------------------- what does not fit


@pytest.mark.parametrize("raw_from", [0, 1, 3, -1, 1 << 40, True, "2", [2], {}, 2.0])
def test_frame_of_a_result_must_be_there(tmp_path: Path, raw_from: object) -> None:
    """Frame 2 has data, 1 has none, 3 comes later."""
    path = tmp_path / "run.mcap"
    frames = [came("left", data) for data in (b"", b"ab", b"cd")]
    kind, text = KINDS["results"], json.dumps(raw_from)

    def told(one: Result[Any], number: int | None = None) -> str:
        assert number == 2
        return str(kind.to_text(one, number)).replace('"raw_from":2', f'"raw_from":{text}')

    with mock.patch.dict(KINDS, results=kind._replace(to_text=told)):
        record_items(path, [*frames[:2], result("left", b"ab"), *frames[2:]])
    remark = load_recording(path).remark
    assert "the file is damaged after message 2: raw_from: " in remark
