"""Fixtures that several modules of the emulator's tests share."""

from typing import Any

import pytest

from smartcam.emulator import ManualClock


@pytest.fixture(params=["tcp", "udp"])
def transport(request: pytest.FixtureRequest) -> Any:
    return request.param


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()
