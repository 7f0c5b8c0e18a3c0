"""BLAS has one thread while something is calibrated, and what it had afterwards."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smartcam.calibration import fit_plane
from smartcam.calibration._inside import OneBlasThread

if TYPE_CHECKING:
    from collections.abc import Iterator

threadpoolctl = pytest.importorskip("threadpoolctl")

PATIENCE = 30.0
"""Seconds; only what hangs takes as long."""


def threads() -> list[int]:
    """Return the number of threads of each BLAS in the process."""
    np.ones((2, 2)) @ np.ones((2, 2))
    return [
        one["num_threads"] for one in threadpoolctl.threadpool_info() if "blas" in one["prefix"]
    ]


@pytest.fixture(autouse=True)
def two_threads() -> Iterator[None]:
    """Have two, also where the machine has one core."""
    with threadpoolctl.threadpool_limits(2, "blas"):
        assert set(threads()) == {2}
        yield


def test_there_is_one_inside_and_two_afterwards() -> None:
    with OneBlasThread():
        assert set(threads()) == {1}
    assert set(threads()) == {2}


def test_an_error_gives_them_back() -> None:
    with pytest.raises(RuntimeError, match="inside"), OneBlasThread():
        raise RuntimeError("inside")
    assert set(threads()) == {2}


def test_each_of_two_threads_gives_them_back() -> None:
    one, entered, leave, seen = OneBlasThread(), threading.Event(), threading.Event(), set[int]()

    def stay() -> None:
        with threadpoolctl.threadpool_limits(2, "blas"):
            with one:
                entered.set()
                assert leave.wait(PATIENCE)
            seen.update(threads())

    other = threading.Thread(target=stay)
    with one:
        other.start()
        assert entered.wait(PATIENCE)
    assert set(threads()) == {2}
    leave.set()
    other.join(PATIENCE)
    assert set(threads()) == seen == {2}


def test_within_itself_it_stays_one() -> None:
    one = OneBlasThread()
    with one:
        with one:
            assert set(threads()) == {1}
        assert set(threads()) == {1}
    assert set(threads()) == {2}


def test_a_copy_in_a_fork_begins_anew() -> None:
    one = OneBlasThread()
    with one:
        one.forked()
        with one:
            assert set(threads()) == {1}
    assert not one._inside  # who was inside in front of the fork leaves without a trace


def test_a_plane_is_fitted_with_one() -> None:
    seen: list[int] = []
    marks = np.array([[0.0, 0.0], [100.0, 0.0], [0.0, 100.0], [100.0, 100.0]])

    class Looking:
        def __array__(self, *_: object, **__: object) -> Any:
            seen.extend(threads())
            return marks

    fit_plane(Looking(), np.column_stack([marks / 1000, np.zeros(4)]))
    assert set(seen) == {1}
    assert set(threads()) == {2}
