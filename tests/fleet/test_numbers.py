"""The numbers of an agent, and the page that lists them."""

from __future__ import annotations

import smartcam
from smartcam import exceptions
from tests.fleet.inside import _SUM_TEXTS as SUM_NAMES
from tests.fleet.inside import OUTCOMES, outcome_of
from tests.web.test_operations import ask, parser, watched, words_of


async def test_page_lists_every_number_and_no_other() -> None:
    said = {
        word.partition("{")[0]
        for title in ("metric of each camera", "metric of the agent")
        for word in words_of(title)
    }
    async with watched("one", latency="camera") as (_, site, fleet, _boxes):
        await fleet["one"].trigger()
        families = [*parser.text_string_to_metric_families((await ask(site, "/metrics"))[1])]
    there = {f"{one.name}_total" if one.type == "counter" else one.name for one in families}
    frames = {"smartcam_frames_total", "smartcam_frames_lost_total", "smartcam_frame_streams"}
    outlets = {one for one in said if one == "outlet" or one.startswith("smartcam_outlet_")}
    assert said <= there | frames | outlets  # this agent has none of both
    # those that the page has together as "and others"
    others = {f"{name}_total" for name, _ in SUM_NAMES.values()}
    own = {name for name in there if name.startswith("smartcam_")}
    assert own - said - others == set()


def test_page_has_the_words_of_outcomes() -> None:
    assert words_of("metric of each camera", 1) >= set(OUTCOMES)


def test_each_error_has_an_outcome() -> None:
    kinds = [getattr(exceptions, name) for name in exceptions.__all__]
    words = {outcome_of(kind.__new__(kind)) for kind in (*kinds, Exception, TimeoutError)}
    assert words < {*OUTCOMES}
    assert outcome_of(smartcam.TriggerTimeoutError("late")) == "timeout"
