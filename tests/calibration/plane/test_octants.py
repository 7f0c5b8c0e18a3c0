"""The thesis' 4.4 in general: planes in each of the eight octants.

The thesis had two set-ups in each octant, and compared by eye. Here the plane's origin lies in the
octant, its normal and its turn about it are any, so are the camera's mark and the camera's scale.
The chain's results are compared with the truth at random points and headings.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pytest

from smartcam.calibration import Chain, chain_of, fit_plane
from tests.calibration.inside import CameraPosition2D, RealWorldPosition
from tests.geometry.rigid import OCTANTS, localization, rotation_about, yaw

if TYPE_CHECKING:
    from numpy.typing import NDArray

SETUPS = 25
"""Random set-ups in each octant; the thesis had two."""

PARTS = 10

octants = pytest.mark.parametrize("octant", OCTANTS, ids=lambda o: "".join("-+"[s > 0] for s in o))


class Setup(NamedTuple):
    """A cell with the pose of the sheet and the camera's coordinates."""

    origin: NDArray[np.float64]
    rotation: NDArray[np.float64]
    mark: NDArray[np.float64]
    mark_theta: float
    unit: float
    """Metres in one of the camera's units."""

    def seen(self, sheet: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the camera's coordinates of points (N, 2) of the sheet, metres."""
        return sheet @ yaw(self.mark_theta)[:2, :2].T / self.unit + self.mark

    def real(self, sheet: NDArray[np.float64]) -> NDArray[np.float64]:
        return sheet @ self.rotation[:, :2].T + self.origin

    def heading(self, theta: float) -> NDArray[np.float64]:
        """Return the direction of a part with the angle ``theta`` in the camera's frame."""
        on_sheet = theta - self.mark_theta
        return self.rotation[:, :2] @ [np.cos(on_sheet), np.sin(on_sheet)]


def setups(octant: tuple[int, int, int]) -> list[Setup]:
    random = np.random.default_rng([2026, *(sign + 1 for sign in octant)])
    found = []
    for number in range(SETUPS):
        normal = random.normal(size=3) if number >= 6 else (np.eye(3)[number // 2] * (-1) ** number)
        found.append(
            Setup(
                np.array(octant) * random.uniform(0.05, 2.0, 3),
                rotation_about(normal, random.uniform(-np.pi, np.pi)),
                random.uniform(-0.2, 0.2, 2),
                random.uniform(-np.pi, np.pi),
                10 ** random.uniform(-4, 0),
            )
        )
    return found


def check(setup: Setup, chain: Chain, random: np.random.Generator) -> None:
    """Compare positions, headings and normals of random parts with the truth."""
    sheet = random.uniform(-0.15, 0.15, (PARTS, 2))
    thetas = random.uniform(-np.pi, np.pi, PARTS)
    parts = [
        localization(x, y, theta)
        for (x, y), theta in zip(setup.seen(sheet).tolist(), thetas.tolist(), strict=True)
    ]
    for part, place, theta in zip(chain.to_robot(parts), setup.real(sheet), thetas, strict=True):
        np.testing.assert_allclose(part.pose.position, place, rtol=0, atol=1e-12)
        x, y, z, w = part.pose.orientation
        heading = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
        normal = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
        np.testing.assert_allclose(heading, setup.heading(theta), rtol=0, atol=1e-9)
        np.testing.assert_allclose(normal, setup.rotation[:, 2], rtol=0, atol=1e-9)


@pytest.mark.sampled(every=3)
@octants
def test_octant_three_touches_and_the_two_solvers_are_right(octant: tuple[int, int, int]) -> None:
    random = np.random.default_rng(1)
    for setup in setups(octant):
        on_a, on_b = random.uniform(0.05, 0.3, 2)
        o, a, b = setup.real(np.array([[0, 0], [on_a, 0], [0, on_b]]))
        camera = CameraPosition2D(setup.mark, setup.mark_theta, setup.unit)
        check(setup, Chain([camera, RealWorldPosition.from_touches(o, a, b)]), random)


@pytest.mark.sampled(every=3)
@octants
def test_octant_fitted_plane_as_a_chain_is_right(octant: tuple[int, int, int]) -> None:
    random = np.random.default_rng(2)
    for setup in setups(octant):
        sheet = np.array([[0, 0], [0.2, 0], [0, 0.15], [0.2, 0.15], [0.1, 0.08]])
        calibration = fit_plane(setup.seen(sheet), setup.real(sheet), model="similarity")
        check(setup, chain_of(calibration, origin=setup.mark, theta=setup.mark_theta), random)
