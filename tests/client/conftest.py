"""Fixtures that several modules of the client's tests share."""

from typing import Any

import pytest


@pytest.fixture(params=["tcp", "udp"])
def transport(request: pytest.FixtureRequest) -> Any:
    return request.param


@pytest.fixture
def never_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """However soon a session is lost again, nobody has taken the camera."""
    monkeypatch.setattr("smartcam._client.supervisor.TAKEN_WITHIN", float("-inf"))
