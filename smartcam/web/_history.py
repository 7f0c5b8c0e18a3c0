"""Keep the outcomes of a camera's results during a shift, and its last failures."""

from __future__ import annotations

import collections
import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Final

from smartcam.web._verdicts import describe_failures, outcome_of

if TYPE_CHECKING:
    from smartcam.models import Result
    from smartcam.web._verdicts import Outcome

SHIFT_SECONDS: Final = 36_000
"""Seconds for which outcomes are kept."""

BAR_SECONDS: Final = 300
"""Seconds of results in a bar of the trend."""

MAX_BARS: Final = SHIFT_SECONDS // BAR_SECONDS
"""Largest number of bars that are kept."""

SLOT_SECONDS: Final = 1800
"""Seconds of results in a slot of the short trend."""

MAX_FAILURES: Final = 50
"""Largest number of failures that are kept; equal failures in a row count as one."""

MAX_PICTURES: Final = 12
"""Largest number of pictures of failures that are kept."""

MAX_PICTURE_BYTES: Final = 1 << 25
"""Largest number of bytes that the pictures of failures may have together."""

MAX_TEXT_CHARACTERS: Final = 300
"""Largest number of characters of the text of a failure."""

KINDS: Final = ("passed", "failed", "other", "errors")
"""Outcomes of a result, in the order of a bar's numbers."""


@dataclass(slots=True)
class Failure:
    """Equal failures in a row: failed or unreadable results, or a lost connection.

    Attributes:
        serial: number of this entry among all failures, from 1.
        at: time of the first of the equal failures, seconds since 1970.
        until: time of the last of the equal failures, seconds since 1970.
        number: number of the first failed result; None if no result belongs to the failure.
        what: text of the failure.
        count: number of equal failures.
    """

    serial: int
    at: float
    until: float
    number: int | None
    what: str
    count: int = 1


class ShiftHistory:
    """The outcomes and failures of one camera during the last shift.

    Attributes:
        version: number of changes so far, by which a reader detects a change.
        failed_since: time of the first failure after the last pass, seconds since 1970; None if
            the last result with a verdict has passed.
        in_a_row: number of failed results since the last result that passed.
        totals: results of the shift by their outcomes, in the order of :data:`KINDS`.
    """

    def __init__(self) -> None:
        self.version: int = 0
        self.failed_since: float | None = None
        self.in_a_row: int = 0
        self.totals: list[int] = [0, 0, 0, 0]
        self._bars: collections.deque[list[int]] = collections.deque()
        self._failures: collections.deque[Failure] = collections.deque(maxlen=MAX_FAILURES)
        self._pictures: collections.OrderedDict[int, bytes] = collections.OrderedDict()
        self._serial = 0  # serial of the last failure
        self._newest_failure = 0  # serial of the newest result if it is a failure, else 0
        self._failed_count = 0
        self._has_passed = False  # whether a result has passed since the last failure

    def add(self, result: Result[Any]) -> Outcome:
        """Count a result; return its outcome."""
        outcome = outcome_of(result.value)
        at = result.received_at.timestamp()
        self._count_outcome(outcome, at)
        self._newest_failure = 0
        if outcome == "failed":
            self._add_failed_result(at, result.number, describe_failures(result.value))
        elif outcome == "passed":
            self.failed_since, self.in_a_row, self._has_passed = None, 0, True
        return outcome

    def add_error(self, text: str) -> None:
        """Count a container that could not be read."""
        at = time.time()
        self._count_outcome("errors", at)
        self._add_failed_result(at, None, f"not readable: {text}")

    def add_missed(self, count: int, text: str) -> None:
        """Count missing results; ``text`` describes them to users."""
        at = time.time()
        self._count_outcome("errors", at, count)
        self._newest_failure = 0
        self._add_failure(at, None, text)

    def add_loss(self, reason: str) -> None:
        """Add a lost connection to the failures."""
        self._newest_failure = 0
        self._add_failure(time.time(), None, f"connection lost: {reason}")

    def _count_outcome(self, outcome: Outcome, at: float, count: int = 1) -> None:
        self.version += 1
        begin = int(at // BAR_SECONDS * BAR_SECONDS)
        if not self._bars or self._bars[-1][0] < begin:
            self._bars.append([begin, 0, 0, 0, 0])
            while self._bars[0][0] <= begin - SHIFT_SECONDS:
                for index, old in enumerate(self._bars.popleft()[1:]):
                    self.totals[index] -= old
        self._bars[-1][1 + KINDS.index(outcome)] += count
        self.totals[KINDS.index(outcome)] += count

    def _add_failed_result(self, at: float, number: int | None, text: str) -> None:
        self._failed_count += 1
        self.in_a_row += 1
        if self.failed_since is None:
            self.failed_since = at
        self._add_failure(at, number, text)
        self._newest_failure = self._serial

    def _add_failure(self, at: float, number: int | None, text: str) -> None:
        self.version += 1
        last = self._failures[-1] if self._failures else None
        if last is not None and last.what == text[:MAX_TEXT_CHARACTERS] and not self._has_passed:
            last.count += 1
            last.until = at
            return
        self._has_passed = False
        self._serial += 1
        self._failures.append(Failure(self._serial, at, at, number, text[:MAX_TEXT_CHARACTERS]))

    # ------------------------------------------------------------------ pictures

    @property
    def wants_picture(self) -> bool:
        """True if the newest result is a failure without a picture."""
        return self._newest_failure > 0 and self._newest_failure not in self._pictures

    def attach_picture(self, serial: int, picture: bytes) -> None:
        """Keep a failure's first picture; drop the oldest failures' pictures to make room."""
        if not serial or serial in self._pictures or len(picture) > MAX_PICTURE_BYTES:
            return
        self._pictures[serial] = picture
        while (
            len(self._pictures) > MAX_PICTURES
            or sum(map(len, self._pictures.values())) > MAX_PICTURE_BYTES
        ):
            self._pictures.popitem(last=False)
        self.version += 1

    def drop_picture(self, serial: int) -> None:
        """Drop the picture of a failure."""
        if self._pictures.pop(serial, None) is not None:
            self.version += 1

    @property
    def newest_result_failure(self) -> int:
        """Serial of the newest result if it is a failure, else 0."""
        return self._newest_failure

    def picture(self, serial: int) -> bytes | None:
        """Return the picture of a failure, None without one."""
        return self._pictures.get(serial)

    # ------------------------------------------------------------------ for the page

    def as_json(self) -> dict[str, Any]:
        """Return the history for the page: bars, and the failures, the oldest first."""
        failures = [
            {**asdict(failure), "picture": failure.serial in self._pictures}
            for failure in self._failures
        ]
        return {
            "bars": [*self._bars],
            "failures": failures,
            "failed": self._failed_count,
            "failed_since": self.failed_since,
            "in_a_row": self.in_a_row,
        }

    def trend(self) -> dict[str, Any]:
        """Return the short trend, for a row of a table.

        ``end`` is the end of the last slot, seconds since 1970. ``characters`` has one for each
        slot of :data:`SLOT_SECONDS`, without the empty slots at the beginning. A digit is the share
        of failed results and errors, in tenths, rounded up, among these and the results that
        passed; ``X``: all failed; ``-``: no result had a verdict; a space: no results.
        """
        if not self._bars:
            return {"end": 0, "characters": ""}
        last = self._bars[-1][0] // SLOT_SECONDS
        count = SHIFT_SECONDS // SLOT_SECONDS
        slots = [[0, 0, 0, 0] for _ in range(count)]
        for begin, *outcomes in self._bars:
            index = begin // SLOT_SECONDS - last + count - 1
            if index >= 0:
                slots[index] = [
                    total + added for total, added in zip(slots[index], outcomes, strict=True)
                ]
        return {
            "end": (last + 1) * SLOT_SECONDS,
            "characters": "".join(map(_slot_character, slots)).lstrip(" "),
        }


def _slot_character(outcomes: list[int]) -> str:
    """Return the character of a slot of the short trend."""
    passed, failed, other, errors = outcomes
    bad_count, verdict_count = failed + errors, passed + failed + errors
    if verdict_count:
        return "0123456789X"[-(-10 * bad_count // verdict_count)]
    return "-" if other else " "
