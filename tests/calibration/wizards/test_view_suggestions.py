"""The next view: fixed at first, then by the uncertainty of the earlier views."""

from __future__ import annotations

from smartcam.calibration._inside import STANDARD_VIEWS, suggest_view
from tests.calibration import lenskit
from tests.calibration.inside import outline
from tests.calibration.lens.estimates import spread_poses

VIEWS = lenskit.seen(lenskit.LEFT, spread_poses(lenskit.LEFT, 3))


def test_first_views_are_always_the_same() -> None:
    for count in (1, 2):
        found = suggest_view(VIEWS[:count], lens_known=False)
        assert found.text == STANDARD_VIEWS[count].text
        assert (found.outline == outline(STANDARD_VIEWS[count], lenskit.BOARD, (640, 480))).all()
        assert found.gain == ""


def test_three_views_say_which_one_helps_the_lens_most() -> None:
    found = suggest_view(VIEWS, lens_known=False)
    assert found.text.startswith("with the sheet ")
    assert found.text not in {look.text for look in STANDARD_VIEWS}
    present, after = (float(word) for word in found.gain.split() if word[0].isdigit())
    assert after < present
    assert ((found.outline > 0) & (found.outline < [640, 480])).all()


def test_known_lens_leaves_the_robot_its_views() -> None:
    assert suggest_view(VIEWS, lens_known=True).text == STANDARD_VIEWS[3].text


def test_views_that_tell_no_lens_are_followed_by_the_usual_ones() -> None:
    assert suggest_view([VIEWS[0]] * 3, lens_known=False).text == STANDARD_VIEWS[3].text
