"""Entries that an outlet delivers: results, errors and gaps; and their account."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, TypeAlias

Kind: TypeAlias = Literal["result", "error", "gap"]


class OutletEntry(NamedTuple):
    """A result, an error or a gap, as it is stored in the spool.

    Attributes:
        camera: name of the camera.
        epoch: number of the outlet's start; grows with each start, also if the clock was set back.
        number: number of the entry within its epoch and camera, from 1, for results and errors
            together. A gap has the number of the last entry that it replaces.
        kind: ``result``, ``error``, or ``gap`` for entries that are lost.
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
        """Id of the entry, by which the far end detects a repetition: ``CAMERA/EPOCH/NUMBER``."""
        gap = "/gap" if self.kind == "gap" else ""
        return f"{self.camera}/{self.epoch}/{self.number}{gap}"


class OutletAccount(NamedTuple):
    """The account of an outlet: ``results == delivered + spooled + dropped``, always.

    Errors count as results; gaps do not count.

    Attributes:
        results: results and errors that came.
        delivered: results and errors that the far end accepted.
        spooled: results and errors that wait, on the disk or for the disk.
        dropped: results and errors that were dropped, by reason: ``full`` by the policy of a full
            spool,
            ``memory`` while the disk was unavailable or too slow, ``refused`` by the far end,
            ``damaged`` in a damaged spool.
    """

    results: int = 0
    delivered: int = 0
    spooled: int = 0
    dropped: dict[str, int] = {}  # noqa: RUF012 - never changed

    @property
    def balanced(self) -> bool:
        """Return True if the account balances."""
        return self.results == self.delivered + self.spooled + sum(self.dropped.values())

    def fields(self) -> dict[str, Any]:
        """Return the account as values for JSON."""
        return self._asdict()
