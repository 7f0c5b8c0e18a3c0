"""The storm over a plant, short: ``plant_storm.py``."""

from __future__ import annotations

import pytest

pytest.importorskip("zenoh")
pytest.importorskip("cryptography")
pytest.importorskip("mcap")
pytest.importorskip("fcntl")

from tests.proofs.plant_faults import SHORT, Happening
from tests.proofs.plant_hosts import HUB, LINE, NoNamespacesError, hosts
from tests.proofs.plant_judge import Storm
from tests.proofs.plant_pace import MOST, Limit, Pace
from tests.proofs.plant_pair import PAIRED, Pair, PairWatch, Told
from tests.proofs.plant_storm import storm_over

SEED = 1


@pytest.mark.long
@pytest.mark.real_time
@pytest.mark.widest
async def test_plant_in_a_storm_mixes_up_nothing_and_loses_nothing_unseen(
    capsys: pytest.CaptureFixture[str],
) -> None:
    try:
        with hosts(LINE, SEED) as switch:
            storm = await storm_over(switch, cameras=6, seed=SEED, seconds=None, say=lambda _: None)
    except NoNamespacesError as error:
        pytest.skip(f"namespaces: {error}")
    with capsys.disabled():
        print(f"\nseed {SEED}\n{storm.report()}")  # noqa: T201
    assert storm.figures.violations == []
    assert {*storm.done} == {one.name for happening in SHORT for one in happening}
    assert storm.figures.outcomes["result"] > 50
    assert storm.accounts["taken"] > 150
    for name in ("agent killed", "router cut off"):
        assert len(storm.taken_over[name]) == len(PAIRED)
    assert switch.carried > 1000
    assert switch.lost > 10


FINE = {
    "first": 1,
    "last": 9,
    "number": 9,
    "seen": 6,
    "gaps": [2, 1],
    "again": 0,
    "offered": 7,
    "taken": 6,
    "dropped": 1,
    "queued": 0,
    "missed": 2,
}


@pytest.mark.parametrize(
    ("wrong", "kills", "said"),
    [
        ({}, 0, ""),
        ({"missed": 1}, 0, "lacks results"),
        ({"missed": 0}, 1, ""),  # the greater gap is what a killed agent took with it
        ({"missed": 0, "dropped": 0, "offered": 6}, 1, "lacks results"),
        ({"missed": 3}, 0, "more in its account"),
        ({"missed": 3, "first": 2, "last": 10}, 0, ""),
        ({"missed": 4, "first": 2, "last": 10}, 0, "more in its account"),
        ({"again": 1}, 0, "once more"),
        ({"dropped": 2}, 0, "balance"),
        ({"taken": 7, "offered": 8}, 0, "took"),
    ],
)
def test_account_is_judged(wrong: dict[str, int], kills: int, said: str) -> None:
    storm = Storm()
    storm.judge_account("camera", kills, {**FINE, **wrong})
    found = storm.figures.violations
    assert (any(said in text for text in found)) if said else found == []


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ([60.0, *[90.0] * 100], []),  # at first it fills its caches
        ([70.0] * 45 + [90.0] * 14, []),  # not there for long enough
        ([70.0] * 45 + [90.0] * 15, ["agent: memory grew from 70.0 to 90.0 MB"]),
    ],
)
def test_memory_is_judged_of_a_process_that_is_warm(values: list[float], said: list[str]) -> None:
    storm = Storm()
    storm.memory["agent"] = values
    storm.judge_memory()
    assert storm.figures.violations == said


# ---------------------------------------------------------------------- the pair

CAMERA = PAIRED[0]
KILLED = Happening("agent killed", 1, 1.0)
SPLIT = Happening("router cut off", 1, 12.0)
AWAY = Happening("router killed", HUB, 3.0)


def pair_of(holder: int) -> Pair:
    pair = Pair()
    for name in PAIRED:
        pair.hear(name, holder)
    return pair


def told(count: int) -> Told:
    return {host: dict.fromkeys(PAIRED, count) for host in (1, 2, 3)}


@pytest.mark.parametrize(
    ("holder", "happening", "takes_over"),
    [
        (1, [KILLED], True),
        (1, [SPLIT], True),
        (2, [KILLED], False),  # who stands by is gone
        (1, [Happening("cable cut", 1, 1.0)], False),  # for less than the lease
        (1, [Happening("cable cut", 1, 10.0)], True),
        (1, [KILLED, Happening("cable cut", 2, 1.0)], False),
        (1, [KILLED, Happening("disk full", 2, 5.0)], True),
        (1, [KILLED, AWAY], False),
        (1, [AWAY], False),
    ],
)
def test_it_is_known_when_one_takes_over(
    holder: int, happening: list[Happening], takes_over: bool
) -> None:
    watch = PairWatch(pair_of(holder), Storm(), happening, told(0))
    found = watch.successor(CAMERA)
    assert (found is not None) == takes_over
    if found is not None:
        assert found == (3 - holder, happening[0])


@pytest.mark.parametrize(
    ("holder", "happening", "moves", "told_of", "said"),
    [
        (1, [KILLED], [], 0, ""),
        (1, [KILLED], [2], 1, ""),
        (1, [KILLED], [2], 0, "were not told"),
        (1, [KILLED], [2, 1], 2, "may be 1 times"),
        (2, [KILLED], [1], 1, "may be 0 times"),
        (1, [SPLIT], [2, 1, 2], 1, ""),
        (1, [SPLIT], [2, 1, 2, 1, 2], 1, "may be 4 times"),
        (1, [Happening("cable cut", 1, 1.0)], [2], 1, "may be 0 times"),  # less than the lease
        (1, [AWAY], [2], 1, "may be 0 times"),
        (1, [AWAY, Happening("5 % of packets lost", 1, 5.0)], [2], 1, ""),
        (1, [Happening("program stopped", 1, 5.0)], [2], 1, "may be 0 times"),
    ],
)
def test_pair_is_judged(
    holder: int, happening: list[Happening], moves: list[int], told_of: int, said: str
) -> None:
    pair, storm = pair_of(holder), Storm()
    watch = PairWatch(pair, storm, happening, told(0))
    for host in moves:
        pair.hear(CAMERA, None)
        pair.hear(CAMERA, host)
    watch.judge(told(told_of))
    found = storm.figures.violations
    assert (any(said in text for text in found)) if said else found == []
    assert storm.moves[happening[0].name] == len(moves)


def test_exactly_one_agent_has_a_camera() -> None:
    pair = pair_of(2)
    assert pair.agreed(dict.fromkeys(PAIRED, ("host2",)))
    assert not pair.agreed(dict.fromkeys(PAIRED, ("host1",)))  # who has no session
    assert not pair.agreed(dict.fromkeys(PAIRED, ("host1", "host2")))
    assert not pair.agreed({CAMERA: ("host2",)})
    pair.hear(CAMERA, None)
    assert not pair.agreed(dict.fromkeys(PAIRED, ("host2",)))


# ---------------------------------------------------------------------- the pace


def test_work_may_take_as_long_as_this_computer_makes_it() -> None:
    pace, limit = Pace(), Limit(2.0, 5.0)
    assert pace.end(100.0, limit) == 107.0
    pace.note(99.0, 7.0)  # before
    pace.note(101.0, 2.0)
    pace.note(102.0, 4.0)
    assert pace.end(100.0, limit) == 100.0 + 5.0 + 3 * 2.0
    assert pace.end(102.5, limit) == 102.5 + 5.0 + 4 * 2.0  # as it was last
    pace.note(104.0, 0.5)
    assert pace.end(103.0, limit) == 110.0  # never less
    pace.note(105.0, 1000.0)
    assert pace.end(105.0, limit) == 110.0 + MOST * 2.0
