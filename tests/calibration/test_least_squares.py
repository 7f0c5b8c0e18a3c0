from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from smartcam._extras import load
from smartcam.calibration import fit_plane
from smartcam.calibration._least_squares import (
    MAX_UNKNOWNS_BY_SVD,
    NormalEquations,
    inverse_scaled,
    minimize,
    solve_scaled,
)
from smartcam.calibration._one_blas_thread import OneBlasThread
from smartcam.exceptions import CalibrationError

if TYPE_CHECKING:
    from collections.abc import Iterator

RANDOM = np.random.default_rng(2)
SHARED = RANDOM.normal(size=(30, 4))
OWN = RANDOM.normal(size=(3, 10, 2))
DENSE = np.zeros((30, 10))
"""All columns: the shared ones, then two of each of three poses."""

DENSE[:, :4] = SHARED
for number in range(3):
    DENSE[10 * number : 10 * number + 10, 4 + 2 * number : 6 + 2 * number] = OWN[number]


def normal(residuals: np.ndarray) -> NormalEquations:
    parts = SHARED.reshape(3, 10, 4)
    off = residuals.reshape(3, 10, 1)
    turned = OWN.swapaxes(1, 2)
    return NormalEquations(
        float((residuals**2).sum()),
        SHARED.T @ SHARED,
        SHARED.T @ residuals,
        turned @ OWN,
        (turned @ off)[..., 0],
        turned @ parts,
    )


def test_step_without_damping_is_that_of_all_unknowns_at_once() -> None:
    residuals = RANDOM.normal(size=30)
    shared, own = normal(residuals).step(0.0)
    expected = np.linalg.lstsq(DENSE, residuals, rcond=None)[0]
    np.testing.assert_allclose(np.concatenate([shared, own.ravel()]), expected)


def test_covariance_is_the_blocks_of_the_whole_inverse() -> None:
    shared, own = normal(np.zeros(30)).covariance()
    expected = np.linalg.inv(DENSE.T @ DENSE)
    np.testing.assert_allclose(shared, expected[:4, :4])
    for number, block in enumerate(own):
        some = slice(4 + 2 * number, 6 + 2 * number)
        np.testing.assert_allclose(block, expected[some, some])


@pytest.mark.parametrize("fails", [False, True])
def test_minimize_takes_back_a_step_without_gain(*, fails: bool) -> None:
    """The cost x^2 + 1000 (y - x^2)^2 has a bent valley; beyond a wall there is no cost."""

    def evaluate(at: np.ndarray) -> NormalEquations:
        x, y = at
        residuals = np.array([-x, np.sqrt(1000.0) * (x * x - y)])
        jacobian = np.array([[1.0, 0.0], [-2 * np.sqrt(1000.0) * x, np.sqrt(1000.0)]])
        return NormalEquations.zeros(2, 1, 0)._replace(
            cost=float((residuals**2).sum()),
            shared=jacobian.T @ jacobian,
            shared_right_side=jacobian.T @ residuals,
        )

    def moved(at: np.ndarray, shared: np.ndarray, _own: np.ndarray) -> np.ndarray:
        if fails and np.abs(shared).max() > 2.0:
            raise CalibrationError("too far")
        there: np.ndarray = at + shared
        return there

    found, last = minimize(np.array([3.0, 5.0]), evaluate, moved, min_gain=1e-12)
    np.testing.assert_allclose(found, 0.0, atol=1e-6)
    assert last.cost < 1e-12


def test_minimize_without_a_finite_cost_returns_the_start() -> None:
    nothing = NormalEquations.zeros(2, 1, 6)._replace(cost=np.inf)
    found, last = minimize(7, lambda _: nothing, lambda at, _shared, _own: at, min_gain=1e-9)
    assert (found, last.cost) == (7, np.inf)
    assert np.isnan(last.covariance()[0]).all()


def test_scaled_equations_of_many_units_are_solved() -> None:
    matrix = np.array([[1e12, 1e3], [1e3, 1e-4]])
    expected = np.array([2e-9, -3e7])
    np.testing.assert_allclose(solve_scaled(matrix, matrix @ expected), expected, rtol=1e-6)
    inverse = np.array([[1e-4, -1e3], [-1e3, 1e12]]) / 9.9e7
    np.testing.assert_allclose(inverse_scaled(matrix), inverse, rtol=1e-9)


def test_many_scaled_equations_are_solved_even_if_some_are_missing() -> None:
    rows = RANDOM.normal(size=(90, MAX_UNKNOWNS_BY_SVD + 10))
    expected = RANDOM.normal(size=MAX_UNKNOWNS_BY_SVD + 10)
    np.testing.assert_allclose(solve_scaled(rows.T @ rows, rows.T @ rows @ expected), expected)
    rows[:, -1] = 0.0
    again = solve_scaled(rows.T @ rows, rows.T @ rows @ expected)
    np.testing.assert_allclose(rows @ again, rows @ expected)


# ------------------------------------------------------------------ BLAS has one thread

PATIENCE = 30.0
"""Seconds after which a test fails."""


def threads() -> list[int]:
    """Return the number of threads of each BLAS in the process."""
    np.ones((2, 2)) @ np.ones((2, 2))
    found = load("threadpoolctl").threadpool_info()
    return [one["num_threads"] for one in found if "blas" in one["prefix"]]


@pytest.fixture
def two_threads() -> Iterator[None]:
    """Set two threads, even on a machine with one core."""
    if np.lib.NumpyVersion(np.__version__) < "2.0.0":
        pytest.skip("the BLAS of this NumPy has one number for all threads")
    with load("threadpoolctl").threadpool_limits(2, "blas"):
        assert set(threads()) == {2}
        yield


@pytest.mark.usefixtures("two_threads")
def test_there_is_one_inside_and_two_afterwards() -> None:
    with OneBlasThread():
        assert set(threads()) == {1}
    assert set(threads()) == {2}


@pytest.mark.usefixtures("two_threads")
def test_an_error_gives_them_back() -> None:
    with pytest.raises(RuntimeError, match="inside"), OneBlasThread():
        raise RuntimeError("inside")
    assert set(threads()) == {2}


@pytest.mark.usefixtures("two_threads")
def test_each_of_two_threads_gives_them_back() -> None:
    one, entered, leave, seen = OneBlasThread(), threading.Event(), threading.Event(), set[int]()

    def stay() -> None:
        with load("threadpoolctl").threadpool_limits(2, "blas"):
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


@pytest.mark.usefixtures("two_threads")
def test_nested_limit_stays_at_one_thread() -> None:
    one = OneBlasThread()
    with one:
        with one:
            assert set(threads()) == {1}
        assert set(threads()) == {1}
    assert set(threads()) == {2}


@pytest.mark.usefixtures("two_threads")
def test_a_copy_in_a_fork_begins_anew() -> None:
    one = OneBlasThread()
    with one:
        one.on_fork()
        with one:
            assert set(threads()) == {1}
    assert not one._depths  # a thread that was inside before the fork has no effect in the child


@pytest.mark.usefixtures("two_threads")
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
