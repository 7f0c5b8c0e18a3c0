"""Keep the last results of all cameras, which clients may request."""

from __future__ import annotations

import collections
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from smartcam.outlets._opcua.jobs import VisionResult

MAX_BOOK_CHARACTERS = 1 << 28
"""Largest number of characters that the JSON texts of all kept results may have together."""

MAX_HANDLES = 10_000
"""Largest number of handles that clients have not released; the oldest beyond it are removed."""


class KeptResult(NamedTuple):
    """A result that clients may request.

    Attributes:
        result: the result.
        structure: the result as the nodeset's structure.
        recipe: name of the result's recipe.
        values_json: values of the result as JSON; "" without values.
    """

    result: VisionResult
    structure: Any
    recipe: str
    values_json: str


class ResultBook:
    """The last results, and the handles of clients.

    A client gets a handle with an answer, and releases the handle when it has read the answer.

    Args:
        max_results: largest number of results; the oldest beyond it are removed.
    """

    def __init__(self, max_results: int) -> None:
        self._max_results, self._characters = max_results, 0
        self._results: collections.OrderedDict[str, KeptResult] = collections.OrderedDict()
        self._handles: collections.OrderedDict[int, None] = collections.OrderedDict()
        self._last_handle = 0

    def add(self, kept: KeptResult) -> None:
        """Add a result; an earlier one with the same id is replaced."""
        replaced = self._results.pop(kept.result.id, None)
        self._characters += len(kept.values_json) - (
            0 if replaced is None else len(replaced.values_json)
        )
        self._results[kept.result.id] = kept
        while len(self._results) > self._max_results or (
            self._characters > MAX_BOOK_CHARACTERS and len(self._results) > 1
        ):
            _, oldest = self._results.popitem(last=False)
            self._characters -= len(oldest.values_json)

    def get(self, key: str, camera: str) -> KeptResult | None:
        """Return a camera's result by its id; None if it is unknown, or no longer kept."""
        kept = self._results.get(key)
        return kept if kept is not None and kept.result.camera == camera else None

    def find_results(
        self, camera: str, matches: Callable[[KeptResult], bool]
    ) -> Iterator[KeptResult]:
        """Yield a camera's results for which ``matches`` is true, the newest first."""
        for kept in reversed(self._results.values()):
            if kept.result.camera == camera and matches(kept):
                yield kept

    def new_handle(self, timeout: int) -> int:
        """Return a new handle; 0 for a client that needs none, since its ``timeout`` is 0."""
        if timeout == 0:
            return 0
        self._last_handle = self._last_handle % 0xFFFFFFFF + 1
        self._handles[self._last_handle] = None
        while len(self._handles) > MAX_HANDLES:
            self._handles.popitem(last=False)
        return self._last_handle

    def release(self, handle: int) -> bool:
        """Remove a handle; return False if there was none."""
        if handle not in self._handles:
            return False
        del self._handles[handle]
        return True
