"""Define the section of a fleet file on standby agents."""

from __future__ import annotations

from pydantic import Field

from smartcam.fleet._file.ros import Fields


class Standby(Fields):
    """The settings of a standby agent, which takes over cameras of a lost agent."""

    rank: int = Field(
        0, ge=0, le=3, description="rank among several that stand by: the lowest takes over first"
    )


def expand_standby(value: object) -> object:
    """Return the section for ``standby: true`` or ``false``; other values unchanged."""
    return {} if value is True else None if value is False else value
