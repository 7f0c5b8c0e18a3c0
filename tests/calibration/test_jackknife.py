"""The covariance of an estimate from what it is without each view."""

from __future__ import annotations

import numpy as np
import pytest

from smartcam.calibration._jackknife import jackknife


def test_of_a_mean_it_is_the_variance_of_the_mean() -> None:
    values = np.random.default_rng(3).normal(size=(12, 3))
    left_out = np.array([np.delete(values, one, axis=0).mean(axis=0) for one in range(12)])
    np.testing.assert_allclose(jackknife(left_out), np.cov(values.T) / 12, atol=1e-15)


def test_what_views_have_in_common_counts_as_often_as_there_are_views() -> None:
    random = np.random.default_rng(4)
    found, predicted = [], []
    for _ in range(400):
        groups = random.normal(size=(10, 1)) + 0.1 * random.normal(size=(10, 50))
        left_out = np.array([[np.delete(groups, one, axis=0).mean()] for one in range(10)])
        found.append(groups.mean())
        predicted.append(jackknife(left_out)[0, 0])
    assert 0.85 < np.sqrt(np.mean(predicted)) / np.std(found) < 1.15


def test_one_view_says_nothing() -> None:
    with pytest.raises(ValueError, match="expected 2 views or more, got 1"):
        jackknife(np.zeros((1, 2)))
