"""Edges: accurate places, and errors instead of wrong measurements."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.inspection.inside import (
    Choice,
    Edge,
    EdgeSettings,
    NotMeasuredError,
    NoValueReason,
    PairChoice,
    Polarity,
    Strips,
    find_pair,
    find_point,
    noise_of,
    strip_between,
)
from tests.inspection.rendering import Array, half_plane, photographed, pixel_means

TURN = math.radians(12)
AHEAD = np.array([math.cos(TURN), math.sin(TURN)])
MIDDLE = np.array([30.2, 29.7])
STRIP = strip_between(MIDDLE - 15 * AHEAD, MIDDLE + 15 * AHEAD, 10.0)
SHAPE = (61, 61)
V, U = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)


def edge_at(place: float, blur: float = 0.8, turned: float = 0.0) -> Array:
    """Return the shares of light after an edge at a place along the strip."""
    x, y = MIDDLE + place * AHEAD
    return pixel_means(SHAPE, half_plane((x, y), TURN + turned, blur))


def measured(
    levels: Array, seed: int = 1, noise: float = 2.0, settings: EdgeSettings | None = None
) -> Edge:
    picture = photographed(levels, noise, np.random.default_rng(seed))
    return find_point(picture, STRIP, settings or EdgeSettings(), "single").edge


def refused(levels: Array, seed: int = 1, noise: float = 2.0) -> NoValueReason | None:
    """Return the reason why there is no edge; None if there is an edge."""
    try:
        measured(levels, seed, noise)
    except NotMeasuredError as trouble:
        assert trouble.text  # noqa: PT017 - one of two good outcomes
        return trouble.reason
    return None


@pytest.mark.parametrize("place", [14.0, 14.5, 15.0, 15.4, -14.2, -15.2])
def test_edge_at_the_end_of_its_strip_is_refused(place: float) -> None:
    assert refused(50 + 150 * edge_at(place)) is NoValueReason.AT_BORDER


@pytest.mark.parametrize("white", [215.0, 235.0, 245.0, 250.0, 255.0, 262.0, 300.0, 500.0])
def test_edge_beside_white_is_right_or_refused(white: float) -> None:
    for seed in range(3):
        try:
            found = measured(50 + (white - 50) * edge_at(1.3), seed)
        except NotMeasuredError as trouble:
            assert trouble.reason is NoValueReason.SATURATED  # noqa: PT017 - one of two good outcomes
            assert white >= 250
        else:
            assert abs(found.place - 1.3) < 4 * found.sigma
            assert white < 255


def test_edge_beside_saturated_black_is_refused_unless_allowed() -> None:
    levels = -8 + 150 * edge_at(0.4)
    assert refused(levels) is NoValueReason.SATURATED
    found = measured(levels, settings=EdgeSettings(allow_saturated=True))
    assert abs(found.place - 0.4) < 0.1


@pytest.mark.parametrize(("white", "step"), [(235, 1), (200, 1), (65520, 16)])
def test_edge_beside_any_saturation_level_is_refused_unless_allowed(white: int, step: int) -> None:
    rng = np.random.default_rng(1)
    top = white / step
    steps = 0.2 * top + top * edge_at(0.4) + rng.normal(0.0, 2.0 * top / 235, SHAPE)
    picture = (np.rint(np.minimum(steps, top)) * step).astype(np.uint16)
    settings = EdgeSettings(white=255.0 if white < 256 else 65535.0)
    with pytest.raises(NotMeasuredError, match="white to the limit") as caught:
        find_point(picture, STRIP, settings, "single")
    assert caught.value.reason is NoValueReason.SATURATED
    find_point(picture, STRIP, replace(settings, allow_saturated=True), "single")


@pytest.mark.sampled(every=3)
@pytest.mark.parametrize("noise", [0.0, 0.2, 0.5, 1.0, 2.0, 4.0])
def test_other_levels_are_not_taken_for_saturation(noise: float) -> None:
    for seed in range(20):
        levels = 40 + (150 + seed / 20) * edge_at(0.4)
        assert refused(levels, seed, noise) is None


@pytest.mark.parametrize(
    ("blur", "why"), [(4.5, None), (5.6, NoValueReason.BLURRED), (12, NoValueReason.BLURRED)]
)
def test_edge_out_of_focus_is_refused(blur: float, why: NoValueReason | None) -> None:
    assert refused(50 + 150 * edge_at(0.7, blur)) is why


@pytest.mark.parametrize("wide", [0.7, 1.5, 3.0, 8.0, 14.0])
def test_bar_is_no_single_edge(wide: float) -> None:
    assert (
        refused(50 + 150 * (edge_at(-wide / 2) - edge_at(wide / 2))) is NoValueReason.SEVERAL_EDGES
    )


@pytest.mark.parametrize("apart", [3.0, 5.0, 12.0])
def test_weak_edge_beside_the_expected_edge_is_reported(apart: float) -> None:
    levels = 50 + 150 * edge_at(-2) - 40 * edge_at(-2 + apart)
    assert refused(levels) is NoValueReason.SEVERAL_EDGES


FEATURELESS: dict[str, tuple[Callable[[], Array], set[NoValueReason]]] = {
    "flat": (lambda: np.full(SHAPE, 99.0), {NoValueReason.NO_EDGE}),
    "low contrast": (lambda: 50 + 7 * edge_at(1.0), {NoValueReason.NO_EDGE}),
    "long ramp": (
        lambda: 50 + 2.5 * U,
        {
            NoValueReason.NO_STEP,
            NoValueReason.AT_BORDER,
            NoValueReason.SEVERAL_EDGES,
            NoValueReason.BLURRED,
        },
    ),
    "corner": (lambda: np.where((U > 30) & (V > 30), 200.0, 50.0), {NoValueReason.NO_STEP}),
    "dot": (
        lambda: np.where(np.hypot(U - 30, V - 30) < 4, 200.0, 50.0),
        {NoValueReason.SEVERAL_EDGES},
    ),
    "stripes": (
        lambda: 128 + 60 * np.sin(0.6 * U),
        {NoValueReason.NO_STEP, NoValueReason.SEVERAL_EDGES},
    ),
    "edge along the strip": (
        lambda: 50 + 150 * edge_at(0.0, turned=1.5),
        {NoValueReason.NO_STEP, NoValueReason.SEVERAL_EDGES, NoValueReason.AT_BORDER},
    ),
}


@pytest.mark.parametrize("name", FEATURELESS)
def test_other_changes_of_level_are_refused(name: str) -> None:
    levels, reasons = FEATURELESS[name]
    assert {refused(levels(), seed) for seed in range(3)} <= reasons


def test_noise_alone_is_no_edge() -> None:
    assert {refused(np.full(SHAPE, 99.0), seed, noise=25.0) for seed in range(40)} == {
        NoValueReason.NO_EDGE
    }


def test_strip_outside_of_the_picture_is_refused() -> None:
    strip = strip_between(np.array([50.0, 30.0]), np.array([65.0, 30.0]), 10.0)
    picture = np.full(SHAPE, 99, dtype=np.uint8)
    with pytest.raises(NotMeasuredError) as caught:
        find_point(picture, strip, EdgeSettings(), "single")
    assert caught.value.reason is NoValueReason.OUTSIDE


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (1, 40)])
def test_tiny_picture_is_refused(shape: tuple[int, int]) -> None:
    strip = strip_between(np.array([0.0, 0.0]), np.array([2.0, 0.0]), 1.0)
    with pytest.raises(NotMeasuredError):
        find_point(np.zeros(shape, dtype=np.uint8), strip, EdgeSettings(), "single")


def test_polarity_and_choice_select_the_edge() -> None:
    levels = 50 + 100 * edge_at(-9) - 60 * edge_at(0) + 90 * edge_at(9)
    picture = photographed(levels, 1.0, np.random.default_rng(1))

    def place(which: Choice, polarity: Polarity = "any") -> float:
        settings = EdgeSettings(polarity=polarity)
        return find_point(picture, STRIP, settings, which).edge.place

    assert place("first") == pytest.approx(-9, abs=0.05)
    assert place("last") == pytest.approx(9, abs=0.05)
    assert place("strongest") == pytest.approx(-9, abs=0.05)
    assert place("nearest") == pytest.approx(0, abs=0.05)
    assert place("single", "falling") == pytest.approx(0, abs=0.05)
    assert place("last", "rising") == pytest.approx(9, abs=0.05)
    with pytest.raises(NotMeasuredError, match="2 edges where one was expected"):
        place("single", "rising")


def test_pairs_are_neighbours_of_opposite_polarity() -> None:
    levels = 50 + 60 * (edge_at(-10) - edge_at(-5)) + 120 * (edge_at(3) - edge_at(9))
    picture = photographed(levels, 1.0, np.random.default_rng(1))

    def places(which: PairChoice) -> list[float]:
        found = find_pair(picture, STRIP, EdgeSettings(), which)
        return [one.edge.place for one in found]

    assert places("first") == pytest.approx([-10, -5], abs=0.1)
    assert places("last") == pytest.approx([3, 9], abs=0.1)
    assert places("strongest") == pytest.approx([3, 9], abs=0.1)
    assert places("outermost") == pytest.approx([-10, 9], abs=0.1)
    with pytest.raises(NotMeasuredError, match="4 edges where two were expected"):
        places("single")


def test_pair_of_one_edge_is_refused() -> None:
    picture = photographed(50 + 150 * edge_at(1), 1.0, np.random.default_rng(1))
    with pytest.raises(NotMeasuredError, match="only one edge"):
        find_pair(picture, STRIP, EdgeSettings(), "single")


def test_too_many_edges_are_refused() -> None:
    shape, middle = (21, 440), 10.0
    bars = [
        (24 + 40 * k, 100 + 2 * min(k, 6 - k)) for k in range(7)
    ]  # the outer ones are the weakest
    light = [
        depth * pixel_means(shape, half_plane((at + side, middle), 0.0, 0.8)) * (1 - side / 10)
        for at, depth in bars
        for side in (0, 20)
    ]
    picture = photographed(40 + sum(light, np.zeros(shape)), 1.0, np.random.default_rng(1))

    def strip(end: float) -> Strips:
        return strip_between(np.array([8.0, middle]), np.array([end, middle]), 10.0)

    found = find_pair(picture, strip(254), EdgeSettings(), "outermost")  # 12 edges
    assert [one.pixel[0] for one in found] == pytest.approx([24, 244], abs=0.1)
    choices: tuple[PairChoice, ...] = ("outermost", "first", "last", "strongest")
    for which in choices:
        with pytest.raises(NotMeasuredError, match="14 edges in one strip, 12 at most") as caught:
            find_pair(picture, strip(300), EdgeSettings(), which)
        assert caught.value.reason is NoValueReason.SEVERAL_EDGES
    with pytest.raises(NotMeasuredError, match="14 edges in one strip, 12 at most"):
        find_point(picture, strip(300), EdgeSettings(), "first")
    strongest = find_point(picture, strip(300), EdgeSettings(), "strongest")
    assert min(abs(strongest.pixel[0] - 144), abs(strongest.pixel[0] - 164)) < 0.1


@pytest.mark.parametrize("noise", [0.7, 2.0, 9.0])
def test_noise_is_estimated_beside_edges(noise: float) -> None:
    picture = photographed(50 + 150 * edge_at(1), noise, np.random.default_rng(1))
    assert noise_of(picture) == pytest.approx(math.hypot(noise, 0.29), rel=0.1)


def test_noise_of_a_large_picture_is_estimated_from_a_part() -> None:
    picture = photographed(np.full((900, 1300), 90.0), 3.0, np.random.default_rng(1))
    assert noise_of(picture) == pytest.approx(3.0, rel=0.05)


def test_misfit_of_an_edge_bounds_its_error() -> None:
    plain = measured(50 + 150 * edge_at(-1))
    odd = measured(50 + 150 * edge_at(-1) - 40 * edge_at(1))  # an edge and, hidden in it, another
    assert plain.model_error == 0.0
    assert odd.model_error > 2 * odd.sigma


def test_brightness_that_falls_off_hardly_moves_an_edge() -> None:
    found = measured((50 + 150 * edge_at(1.0)) * (1 - 0.003 * U))
    assert abs(found.place - 1.0) < 0.05


def test_strips_turn_with_their_direction() -> None:
    for turn in np.radians([0, 45, 90, 180, 270, 300]):
        ahead = np.array([math.cos(turn), math.sin(turn)])
        strip = strip_between(MIDDLE - 12 * ahead, MIDDLE + 12 * ahead, 8.0)
        x, y = MIDDLE + 2.25 * ahead
        picture = photographed(
            60 + 120 * pixel_means(SHAPE, half_plane((x, y), turn, 0.7)),
            1.0,
            np.random.default_rng(1),
        )
        found = find_point(picture, strip, EdgeSettings(), "single").edge
        assert abs(found.place - 2.25) < 4 * found.sigma
        assert found.height == pytest.approx(120, rel=0.02)
        assert found.blur == pytest.approx(0.7, abs=0.05)


def test_places_in_a_strip_match_its_points() -> None:
    strips = Strips(MIDDLE[None], AHEAD[None], 20.0, 6.0)
    along, across = np.array([[3.0, -4.0]]), np.array([[1.0, 2.5]])
    back = strips.coordinates_of(strips.points(along, across))
    assert np.allclose(back[0], along)
    assert np.allclose(back[1], across)


def test_strips_with_too_many_pixels_are_refused_at_once() -> None:
    strip = strip_between(np.array([0.0, 300.0]), np.array([599.0, 300.0]), 400.0)
    with pytest.raises(NotMeasuredError) as caught:
        find_point(np.zeros((600, 600), dtype=np.uint8), strip, EdgeSettings(), "single")
    assert caught.value.reason is NoValueReason.TOO_LARGE
