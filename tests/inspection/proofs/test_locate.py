"""The short form of the proof of locating, ``python -m tests.inspection.proofs.locate``."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.inspection.drawn_parts import shares, slopes
from tests.inspection.proofs import locate
from tests.strategies import over

pytestmark = [pytest.mark.long, pytest.mark.widest]

SHORT = (
    "noise 2",
    "blur 1.8",
    "contrast 20",
    "texture",
    "covered 15 %",
    "clutter",
    "scale 0.8 to 1.25",
    "another size",
    "square",
)


@over("name", SHORT)
def test_predicted_errors_are_those_that_are_observed(name: str) -> None:
    (kind,) = (one for one in locate.KINDS if one.name == name)
    row = locate.judge(kind, 20, seed=1)
    assert row.good, f"\n{locate.HEAD}\n{row}"


def test_clean_scenes_are_right_to_a_fraction_of_a_pixel() -> None:
    (kind,) = (one for one in locate.KINDS if one.name == "clean")
    row = locate.judge(kind, 10, seed=1)
    assert row.found == 10
    assert row.median_px < 0.05
    assert row.rms_degrees < 0.02


def test_derivatives_of_the_drawing_are_right() -> None:
    random = np.random.default_rng(1)
    part = locate.scene_of(locate.KINDS[0], random).part
    drawn = slopes((locate.SIDE, locate.SIDE), part, 0.8)
    for number, (name, step) in enumerate((("x", 0.2), ("y", 0.2), ("angle", 0.003))):
        after, before = (
            shares(
                (locate.SIDE, locate.SIDE),
                [dataclasses.replace(part, **{name: getattr(part, name) + way})],
                0.8,
            )
            for way in (step, -step)
        )
        numeric = (after - before) / (2 * step)
        # what is drawn is sampled: smaller steps show its samples
        assert np.abs(numeric - drawn[number]).max() < 0.1 * np.abs(numeric).max()
        assert np.linalg.norm(numeric - drawn[number]) < 0.02 * np.linalg.norm(numeric)
