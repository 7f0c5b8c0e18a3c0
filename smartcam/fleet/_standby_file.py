"""What a fleet file says of standing by."""

from __future__ import annotations

from pydantic import Field

from smartcam.fleet._ros_file import Fields


class Standby(Fields):
    """How an agent stands by for cameras that another one of the fleet has."""

    preference: int = Field(
        0, ge=0, le=3, description="of several that stand by, the lowest takes over first"
    )


def standby_of(given: object) -> object:
    """Return what ``standby: true`` and ``false`` stand for."""
    return {} if given is True else None if given is False else given
