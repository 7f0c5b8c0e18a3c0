"""The benchmarks' own parts: what cuts frames, what is made of several processes, what is said."""

import asyncio
import json
import os
import subprocess
import sys

import pytest

from benchmarks import cores, instructions, runs
from benchmarks.measure import (
    Comparison,
    Curve,
    Goal,
    Instructions,
    Plan,
    Series,
    instructions_of,
)
from benchmarks.peers import wire
from benchmarks.report import as_json, comparison, markdown, table
from benchmarks.starts import imports_of
from benchmarks.yardsticks import BareClient

FRAMES = wire.status(waiting=False) + wire.result(b"abc") + wire.status(waiting=True)

ONE = Comparison(
    "trigger",
    "together",
    Series("smartcam", "us", [60.0, 62.0, 64.0]),
    Series("bare", "us", [10.0, 10.0, 10.0]),
    goal=Goal("at most", 6.3),
    note="a note",
    instructions=Instructions(420_000, 70_000),
)


@pytest.mark.parametrize("size", [1, 5, 11, 12, 13, len(FRAMES) - 1, len(FRAMES)])
async def test_the_bare_protocol_cuts_frames_however_they_come(size: int) -> None:
    class Nowhere:
        def write(self, data: bytes) -> None: ...

    client = BareClient()
    client.transport = Nowhere()
    asked = asyncio.create_task(client.ask(b"", wire.RESULT, count=2))
    await asyncio.sleep(0)
    for data in (FRAMES, FRAMES):
        assert not asked.done()
        for start in range(0, len(data), size):
            piece = data[start : start + size]
            client.get_buffer(-1)[: len(piece)] = piece
            client.buffer_updated(len(piece))
        await asyncio.sleep(0)
    await asked
    assert bytes(client.body) == FRAMES[-8:]


def test_of_several_processes_the_range_goes_from_the_least_median_to_the_most() -> None:
    other = Comparison(
        "trigger", "together", Series("smartcam", "us", [90.0]), Series("bare", "us", [30.0])
    )
    merged = runs.merged([ONE, other])
    assert merged.subject.values == [62.0, 90.0]
    assert merged.spread == (3.0, 6.2)
    assert (merged.goal, merged.instructions) == (ONE.goal, ONE.instructions)
    assert ONE.spread == pytest.approx((6.1, 6.3))  # of one, the middle half of its rounds
    assert "3.00 to 6.20 of 2 processes" in table([merged])


def test_curves_of_several_processes_go_through_the_medians() -> None:
    curves = [Curve("fleet", "t", "x", "y", {"a": [(1, y), (2, 2 * y)]}) for y in (1.0, 5.0, 2.0)]
    assert runs.middle(curves).lines == {"a": [(1, 2.0), (2, 4.0)]}


def test_a_comparison_comes_back_from_its_file() -> None:
    for one in (ONE, Comparison("decode", "alone", Series("a", "us", [1.0]))):
        facts = json.loads(json.dumps(as_json([one], [], {"trigger": 61.0})))
        assert comparison(facts["comparisons"][0]) == one


def test_instructions_have_a_column_where_they_were_counted() -> None:
    assert "420k / 70k = 6.00x" in table([ONE])
    plain = Comparison("trigger", "together", ONE.subject, ONE.yardstick)
    assert "instructions" not in table([plain])
    assert instructions_of({"a": 1.0}, "a", "b") is None


def test_the_page_says_of_which_commit_it_is_how_long_it_took_and_what_is_missing() -> None:
    facts = as_json([ONE], [], {"trigger": 121.0, "sync": 3.0})
    text = markdown([ONE], {}, facts, ["trigger", "stream", "sync"])
    head = text.splitlines()[0]
    assert f"of commit `{facts['commit']}`" in head
    assert "The run took 2 minutes (trigger 2; the others less than one each)." in head
    assert "Not measured here: stream, sync." in head


def test_what_takes_n_operations_is_the_difference_to_twice_as_many() -> None:
    assert instructions.difference(lambda count: 1_000 + 7 * count, 10) == 7.0


def test_nothing_is_counted_without_the_tool(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", "")
    assert instructions.wanted(asked=True) is False
    assert "left out: no valgrind here" in capsys.readouterr().err
    assert instructions.wanted(asked=False) is False
    assert capsys.readouterr().err == ""
    assert instructions.count_sides(Plan(1, 1.0), "trigger", {"smartcam": 1}, 10) == {}


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells a process its cores")
def test_a_side_and_its_peer_have_one_core_or_two() -> None:
    before = os.sched_getaffinity(0)
    for apart in (False, True):
        with cores.placed(apart=apart):
            here = os.sched_getaffinity(0)
            with cores.for_peers():
                there = os.sched_getaffinity(0)
            assert len(here) == len(there) == 1
            assert (here != there) == (apart and len(before) > 1)
            with cores.free():
                assert os.sched_getaffinity(0) == before
        assert os.sched_getaffinity(0) == before


def test_the_yardstick_of_a_start_imports_what_it_needs_and_nothing_of_ours(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name in [one for one in os.environ if one.startswith("COV")]:
        monkeypatch.delenv(name)  # whoever counts lines has imported some of it before
    code = imports_of("import json.tool, smartcam")
    assert "__import__('json.decoder')" in code
    assert "smartcam" not in code
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)  # noqa: S603
