from __future__ import annotations

import numpy as np
import pytest
from lenskit import BOARD, LEFT, poses, seen

from smartcam.calibration.lens.bundle import Sight
from smartcam.calibration.lens.sheet_shape import (
    adjust_shape,
    as_meant,
    held_out_residuals,
    leave_out,
)
from smartcam.calibration.lens.start import fit_lens

RANDOM = np.random.default_rng(11)
OFF = BOARD.points + 2e-4 * RANDOM.normal(size=(54, 3))


def test_as_meant_takes_place_direction_and_size_away() -> None:
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moved = 1.7 * BOARD.points @ turn.T + [0.3, -0.2, 0.5]
    np.testing.assert_allclose(as_meant(moved, BOARD.points), BOARD.points, atol=1e-12)


def test_adjust_shape_finds_where_the_points_are() -> None:
    views = seen(LEFT, poses(15), sigma=0.02, points=OFF)
    sights = [Sight(0, number, view) for number, view in enumerate(views)]
    before = fit_lens(views, "plumb_bob")
    found = adjust_shape(before.bundle, sights, before.more)
    assert found.bundle.points is not None
    off = found.bundle.points - as_meant(OFF, BOARD.points)
    assert np.sqrt((off**2).mean()) < 4e-5
    assert found.more < 0.1 * before.more
    assert found.freedom == before.freedom - 3 * 54 + 7


@pytest.mark.parametrize("free", [False, pytest.param(True, marks=pytest.mark.long)])
def test_leave_out_gives_a_lens_that_did_not_see_the_view(free: bool) -> None:
    views = seen(LEFT, poses(8), points=OFF if free else None)
    spoiled = [*views[:3], seen(LEFT, poses(8, seed=9)[:1], sigma=2.0)[0], *views[4:]]
    found = []
    for some in (views, spoiled):
        sights = [Sight(0, number, view) for number, view in enumerate(some)]
        adjusted = fit_lens(views, "plumb_bob")
        if free:
            adjusted = adjust_shape(adjusted.bundle, sights, adjusted.more)
        found.append(leave_out(adjusted, sights, 3).cameras[0].matrix)
    np.testing.assert_allclose(found[0], found[1], atol=1.0 if free else 1e-3)


def test_held_out_residuals_of_the_true_lens_are_the_noise() -> None:
    views = seen(LEFT, poses(8), sigma=0.1)
    sights = [Sight(0, number, view) for number, view in enumerate(views)]
    bundle = fit_lens(views, "plumb_bob").bundle
    (residuals,) = held_out_residuals(bundle, sights, 2, 0.0)
    assert np.sqrt((residuals**2).mean()) == pytest.approx(0.1, rel=0.2)
