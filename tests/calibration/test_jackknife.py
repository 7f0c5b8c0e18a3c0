"""The covariance of an estimate from the estimates without each view."""

from __future__ import annotations

import numpy as np
import pytest

from smartcam.calibration._jackknife import jackknife


def test_covariance_of_a_mean_is_its_variance() -> None:
    values = np.random.default_rng(3).normal(size=(12, 3))
    left_out = np.array([np.delete(values, one, axis=0).mean(axis=0) for one in range(12)])
    np.testing.assert_allclose(jackknife(left_out), np.cov(values.T) / 12, atol=1e-15)


def test_common_errors_within_a_view_count_once() -> None:
    random = np.random.default_rng(4)
    found, predicted = [], []
    for _ in range(400):
        groups = random.normal(size=(10, 1)) + 0.1 * random.normal(size=(10, 50))
        left_out = np.array([[np.delete(groups, one, axis=0).mean()] for one in range(10)])
        found.append(groups.mean())
        predicted.append(jackknife(left_out)[0, 0])
    assert 0.85 < np.sqrt(np.mean(predicted)) / np.std(found) < 1.15


def test_one_view_gives_no_covariance() -> None:
    with pytest.raises(ValueError, match="expected 2 views or more, got 1"):
        jackknife(np.zeros((1, 2)))
