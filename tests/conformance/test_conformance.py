"""The client in front of every camera that smartcam knows; the checks are the suite's."""

from __future__ import annotations

import pytest
from worlds import BVS_WORLDS, INSIGHT_WORLDS

from smartcam.testing.suites.protocols import CameraSuite

pytestmark = pytest.mark.long


class TestBvs(CameraSuite):
    worlds = BVS_WORLDS


class TestInSight(CameraSuite):
    worlds = INSIGHT_WORLDS
