"""Hypothesis strategies for the suites: bytes, and offsets to cut them at.

Hypothesis refuses a method that several classes inherit as a test, so :func:`run_with_examples`
defines one for each call. Hypothesis' profile sets the number of examples.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

from smartcam._extras import missing_extra_error

try:
    from hypothesis import HealthCheck, given, settings, strategies
except ModuleNotFoundError as _exc:
    raise missing_extra_error("hypothesis") from _exc

st = strategies

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from hypothesis.strategies import DataObject, SearchStrategy

MAX_NOISE_BYTES = 200
"""Largest number of bytes of one piece of noise."""


def run_with_examples(check: Callable[[DataObject], None]) -> None:
    """Call a check with one example after the other; the smallest one that fails is shown.

    Raises:
        AssertionError: the check's error, with the example as a note.
    """
    suppressed_checks = [HealthCheck.too_slow, HealthCheck.data_too_large]

    @settings(deadline=None, report_multiple_bugs=False, suppress_health_check=suppressed_checks)
    @given(data=st.data())
    def check_example(data: DataObject) -> None:
        check(data)

    check_example()


def noise(samples: Sequence[bytes]) -> SearchStrategy[bytes]:
    """Draw any bytes, and samples that are cut, repeated, or have a byte changed."""
    any_bytes: SearchStrategy[bytes] = st.binary(max_size=MAX_NOISE_BYTES)
    if not any(samples):
        return any_bytes
    sample = st.sampled_from([data for data in samples if data])
    return st.one_of(
        any_bytes,
        sample,
        st.builds(lambda data, end: data[:end], sample, st.integers(0, MAX_NOISE_BYTES)),
        st.builds(lambda data, begin: data[begin:], sample, st.integers(0, MAX_NOISE_BYTES)),
        st.builds(_change_byte, sample, st.integers(0, MAX_NOISE_BYTES), st.integers(0, 255)),
        st.builds(lambda data, times: data * times, sample, st.integers(2, 3)),
    )


def _change_byte(data: bytes, offset: int, byte: int) -> bytes:
    offset %= len(data)
    return data[:offset] + bytes([byte]) + data[offset + 1 :]


def draw_pieces(data: DataObject, whole: bytes) -> list[bytes]:
    """Draw offsets to cut bytes at, and return the pieces; none is empty."""
    offsets = data.draw(st.lists(st.integers(0, len(whole)), max_size=8), label="cut at")
    edges = sorted({0, *offsets, len(whole)})
    return [whole[begin:end] for begin, end in pairwise(edges)]
