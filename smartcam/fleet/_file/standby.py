"""Read the section of a fleet file on standing by."""

from __future__ import annotations

from pydantic import Field

from smartcam.fleet._file.ros import Fields


class Standby(Fields):
    """The settings of standing by for another agent's cameras."""

    preference: int = Field(
        0, ge=0, le=3, description="rank among several that stand by: the lowest takes over first"
    )


def standby_of(given: object) -> object:
    """Return the section for ``standby: true`` or ``false``; other values unchanged."""
    return {} if given is True else None if given is False else given
