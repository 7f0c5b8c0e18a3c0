"""One thing that an outlet delivers: a result, an error, or a gap."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, TypeAlias

Kind: TypeAlias = Literal["result", "error", "gap"]


class OutletEntry(NamedTuple):
    """One thing that an outlet delivers, as it stands in the spool.

    Attributes:
        camera: name of the camera.
        epoch: number of the start of whoever numbers; grows with each start, also where the clock
            was set back.
        number: number of the entry within its epoch and camera, from 1, results and errors alike.
            A gap has the number of the last entry that it stands for.
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
        """Id of the entry, by which the far end knows a repetition: ``CAMERA/EPOCH/NUMBER``."""
        gap = "/gap" if self.kind == "gap" else ""
        return f"{self.camera}/{self.epoch}/{self.number}{gap}"


class OutletAccount(NamedTuple):
    """The account of an outlet: ``results == delivered + spooled + dropped``, always.

    Errors count as results do; gaps do not.

    Attributes:
        results: results and errors that came.
        delivered: results and errors that the far end took.
        spooled: results and errors that wait, on the disk or for it.
        dropped: results and errors that were given up, by the reason: ``full`` for the policy of a
            full spool,
            ``memory`` where the disk was away or too slow, ``refused`` where the far end never
            takes it, ``damaged`` where a spool could not be read any more.
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
