from __future__ import annotations

import numpy as np
from lenskit import LEFT, RIG, RIGHT, pairs

from smartcam.calibration.stereo.start import Lenses, as_moments, start


def test_start_is_near_the_truth() -> None:
    left, right = pairs(4)
    lenses = Lenses((LEFT, RIGHT), "plumb_bob", ())
    moments, bundle, apart = start(as_moments(left, right), lenses)
    assert [one[0] for one in moments] == left
    np.testing.assert_allclose(bundle.rig[1].rotation, RIG.rotation, atol=0.01)
    np.testing.assert_allclose(bundle.rig[1].translation, RIG.translation, atol=2e-3)
    assert bundle.shared == 6
    assert apart == {}


def test_start_tells_the_pair_that_does_not_belong_together() -> None:
    left, right = pairs(6)
    views = [*right[:4], right[0], right[5]]
    _, bundle, apart = start(as_moments(left, views), Lenses((LEFT, RIGHT), "plumb_bob", ()))
    assert list(apart) == [4]
    assert apart[4] > 50
    np.testing.assert_allclose(bundle.rig[1].translation, RIG.translation, atol=2e-3)
