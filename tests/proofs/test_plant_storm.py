"""The storm over a plant, short: ``plant_storm.py``."""

from __future__ import annotations

import pytest

pytest.importorskip("zenoh")
pytest.importorskip("cryptography")
pytest.importorskip("mcap")
pytest.importorskip("fcntl")

from tests.proofs.plant_hosts import NoNamespacesError, hosts
from tests.proofs.plant_storm import HUB, SHORT, Site, Storm, storm_over

pytestmark = [pytest.mark.long, pytest.mark.real_time]

SEED = 1


async def test_plant_in_a_storm_mixes_up_nothing_and_loses_nothing_unseen(
    capsys: pytest.CaptureFixture[str],
) -> None:
    try:
        with hosts(HUB, SEED) as switch:
            storm = await storm_over(switch, cameras=6, seed=SEED, seconds=None, say=lambda _: None)
    except NoNamespacesError as error:
        pytest.skip(f"namespaces: {error}")
    with capsys.disabled():
        print(f"\nseed {SEED}\n{storm.report()}")  # noqa: T201
    assert storm.figures.violations == []
    assert {*storm.done} == {name for faults in SHORT for name, _, _ in faults}
    assert storm.figures.outcomes["result"] > 50
    assert storm.accounts["taken"] > 150
    assert storm.accounts["missed"] > 0  # of who was stopped for longer than agents remember
    assert switch.carried > 1000
    assert switch.lost > 10


FINE = {
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
        ({"again": 1}, 0, "once more"),
        ({"dropped": 2}, 0, "balance"),
        ({"taken": 7, "offered": 8}, 0, "took"),
    ],
)
def test_account_is_judged(
    wrong: dict[str, int], kills: int, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    storm = Storm()
    site = Site.__new__(Site)
    monkeypatch.setattr(site, "storm", storm, raising=False)
    site._judge("camera", kills, {**FINE, **wrong})
    found = storm.figures.violations
    assert (any(said in text for text in found)) if said else found == []
