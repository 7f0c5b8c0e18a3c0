from __future__ import annotations

import numpy as np
import pytest
from imaging_scenes import refused
from lenskit import pairs
from scipy.spatial.transform import Rotation

from smartcam.calibration.codes import Code
from smartcam.calibration.geometry.frames import Transform
from smartcam.calibration.lens.bundle import Sight
from smartcam.calibration.stereo.checks import check_fit, remark_sides


def test_check_fit_of_more_pixels_than_can_be_names_the_worst_views() -> None:
    left, right = pairs(2)
    sights = [Sight(0, 0, left[0]), Sight(1, 0, right[0])]
    check_fit(4.9, sights, [])
    with refused("POOR_FIT", "got residuals of 5.1 pixels rms, 5 at most", "worst: 01 (right)"):
        check_fit(5.1, sights, [Sight(1, 1, right[1])])


def test_check_fit_allows_more_where_points_are_not_known_better() -> None:
    left, _ = pairs(2, sigma=0.5)
    sights = [Sight(0, 0, left[0])]
    check_fit(9.9, sights, [])
    with refused("POOR_FIT", "10 at most expected", "worst: all alike"):
        check_fit(10.1, sights, [])


@pytest.mark.parametrize(
    ("turn", "shift", "codes"),
    [
        (0.0, [0.1, 0.01, 0.0], [Code.SWAPPED_SIDES]),
        (0.0, [-0.1, 0.01, 0.0], []),
        (0.0, [0.01, 0.1, 0.0], []),
        (np.pi, [0.1, 0.01, 0.0], []),
    ],
)
def test_remark_sides_is_made_where_the_right_one_is_left(
    turn: float, shift: list[float], codes: list[Code]
) -> None:
    rotation = Rotation.from_rotvec([0.0, 0.0, turn]).as_matrix()
    remarks = remark_sides(Transform("right", "left", rotation, np.array(shift)))
    assert [one.code for one in remarks] == codes
