"""Strategies and makers of rigid motions, and comparisons."""

from __future__ import annotations

from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st

from smartcam.calibration import Transform
from smartcam.exceptions import CalibrationError
from smartcam.models import Header, Localization, Pose, Position, Quaternion

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

NOON = datetime(2026, 3, 4, 12, tzinfo=UTC)

OCTANTS = [(x, y, z) for x in (1, -1) for y in (1, -1) for z in (1, -1)]

AXES = [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)]
"""Normals at which careless formulas divide by zero."""

FEW = settings(max_examples=max(1, settings().max_examples // 5))
"""Number of examples of a slow property: a fifth of the profile's."""

lengths = st.floats(0.01, 10.0)
angles = st.floats(-np.pi, np.pi)


@contextmanager
def refused(code: str, *texts: str) -> Iterator[None]:
    """Check that a calibration is refused with ``code``, and a text that contains ``texts``."""
    with pytest.raises(CalibrationError) as caught:
        yield
    assert caught.value.code == code
    for text in texts:
        assert text in str(caught.value)


def yaw(angle: float) -> NDArray[np.float64]:
    """Return the turn about z."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]])


def after(seconds: float) -> datetime:
    """Return a moment after noon."""
    return NOON + timedelta(seconds=seconds)


@st.composite
def rotations(draw: st.DrawFn) -> NDArray[np.float64]:
    """Any rotation, often one that turns z to an awkward normal."""
    normal = draw(
        st.one_of(
            st.sampled_from(AXES),
            st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1),
        )
    )
    return rotation_about(np.array(normal), draw(angles))


def rotation_about(normal: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    """Return a rotation whose third column is along ``normal``."""
    n = normal / np.linalg.norm(normal)
    helper = np.eye(3)[int(np.argmin(np.abs(n)))]
    x = np.cross(helper, n)
    x /= np.linalg.norm(x)
    plane = np.column_stack([x, np.cross(n, x), n])
    return plane @ yaw(angle)


@st.composite
def translations(draw: st.DrawFn) -> NDArray[np.float64]:
    """Up to 10 m in each direction, in any octant."""
    signs = draw(st.sampled_from(OCTANTS))
    return np.array([sign * draw(lengths) for sign in signs])


@st.composite
def transforms(draw: st.DrawFn, target: str = "base", source: str = "part") -> Transform:
    """Any rigid motion without a time."""
    return Transform(target, source, draw(rotations()), draw(translations()))


def close(first: Transform, second: Transform, tolerance: float = 1e-12) -> bool:
    """Return True if two transforms are equal."""
    return (
        (first.target, first.source, first.at) == (second.target, second.source, second.at)
        and np.allclose(first.rotation, second.rotation, rtol=0, atol=tolerance)
        and np.allclose(first.translation, second.translation, rtol=1e-13, atol=tolerance)
    )


def localization(x: float, y: float, theta: float = 0.0, name: str = "part") -> Localization:
    """Return a localization as a camera reports it."""
    pose = Pose(Header(3, NOON, "camera"), Position(x, y), Quaternion.from_theta(theta))
    return Localization(name, 0.9, 1, pose)
