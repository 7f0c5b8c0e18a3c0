"""Where the next view is to be: outlines that fit into the image, and differ."""

from __future__ import annotations

import numpy as np
import pytest

from smartcam.calibration.targets import Checkerboard
from smartcam.calibration.wizards.view_suggestions import LOOKS, Look, outline

TARGET = Checkerboard(columns=9, rows=6, square=0.025)
SIZE = (640, 480)


@pytest.mark.parametrize("look", LOOKS, ids=lambda look: look.text[:20])
def test_outline_takes_its_part_of_the_image_and_lies_in_it(look: Look) -> None:
    found = outline(look, TARGET, SIZE)
    assert (np.ptp(found, axis=0) / SIZE).max() == pytest.approx(look.fill, abs=0.01)
    assert ((found >= 0) & (found <= SIZE)).all()
    (ax, ay), (bx, by) = found[1] - found[0], found[3] - found[0]
    assert ax * by - ay * bx < 0  # seen from the front: y up on the sheet, v down


def test_outline_from_the_front_is_upright_and_turned_by_a_quarter_it_lies() -> None:
    straight, turned = (outline(LOOKS[one], TARGET, SIZE) for one in (0, 5))
    assert straight[0] == pytest.approx([128, 360])
    assert straight[2] == pytest.approx([512, 120])
    assert np.ptp(turned, axis=0)[0] < np.ptp(turned, axis=0)[1]


def test_outline_tilted_is_nearer_on_one_side() -> None:
    widths = [np.ptp(outline(LOOKS[one], TARGET, SIZE)[:2, 0]) for one in (1, 2)]
    assert abs(widths[0] - widths[1]) > 30
