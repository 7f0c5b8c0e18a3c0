"""Define the entries that an outlet delivers (results, errors, gaps), and the counts of entries."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, TypeAlias

Kind: TypeAlias = Literal["result", "error", "gap"]


class OutletEntry(NamedTuple):
    """A result, an error or a gap, as it is stored in the spool.

    Attributes:
        camera: name of the camera.
        epoch: number of the outlet's start, larger than that of every earlier start, even if the
            clock was set back.
        number: number of the entry within its epoch and camera, from 1, for results and errors
            together. A gap has the number of the last entry that it replaces.
        kind: ``result``, ``error``, or ``gap``, which stands for lost entries.
        application: application of a result; None for errors and gaps.
        at: time of arrival, seconds since 1970, UTC.
        body: text of a JSON object: the fields of a result, or ``error`` and ``kind``.
    """

    camera: str
    epoch: int
    number: int
    kind: Kind
    application: int | None
    at: float
    body: str

    @property
    def id(self) -> str:
        """Id by which a receiver recognizes an entry that it already has: CAMERA/EPOCH/NUMBER."""
        gap = "/gap" if self.kind == "gap" else ""
        return f"{self.camera}/{self.epoch}/{self.number}{gap}"


class OutletCounts(NamedTuple):
    """An outlet's counts, for which ``results == delivered + spooled + dropped`` always holds.

    Errors count as results; gaps do not count.

    Attributes:
        results: results and errors that came.
        delivered: results and errors that the far end accepted.
        spooled: results and errors that wait for delivery, in the spool or still in memory.
        dropped: results and errors that were dropped, by reason. ``full``: the spool was full.
            ``memory``: the disk was unavailable or too slow. ``refused``: the receiver refused
            them for good. ``damaged``: the spool's file was damaged.
    """

    results: int = 0
    delivered: int = 0
    spooled: int = 0
    dropped: dict[str, int] = {}  # noqa: RUF012 - never changed

    @property
    def balanced(self) -> bool:
        """Return True if each result is delivered, spooled or dropped, and counted once."""
        return self.results == self.delivered + self.spooled + sum(self.dropped.values())

    def fields(self) -> dict[str, Any]:
        """Return the counts as values for JSON."""
        return self._asdict()
