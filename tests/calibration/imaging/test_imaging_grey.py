"""Images as detectors take them."""

from __future__ import annotations

import numpy as np
import pytest

from smartcam.calibration.detection.image import grey_image, scaled
from smartcam.calibration.detection.sampling import mean_level


def test_grey_image_of_bytes_keeps_them() -> None:
    image = np.arange(20 * 30, dtype=np.uint16).reshape(20, 30).astype(np.uint8)
    grey = grey_image(image)
    np.testing.assert_array_equal(grey.bytes, image)
    np.testing.assert_array_equal(grey.levels, image)
    assert grey.size == (30, 20)
    assert grey.levels.dtype == np.float32


@pytest.mark.parametrize("brightest", [1023, 4095, 65535])
def test_grey_image_of_16_bits_fills_255_with_its_brightest(brightest: int) -> None:
    image = np.zeros((20, 30), dtype=np.uint16)
    image[0, :2] = (brightest, brightest // 2)
    grey = grey_image(image)
    assert grey.bytes[0, 0] == 255
    assert grey.levels[0, 1] == pytest.approx(127.5, abs=0.2)


def test_grey_image_of_black_16_bits_is_black() -> None:
    assert grey_image(np.zeros((20, 30), dtype=np.uint16)).bytes.max() == 0


def test_grey_image_of_colours_weighs_blue_green_red() -> None:
    image = np.zeros((16, 16, 3), dtype=np.uint8)
    image[:, :, 2] = 200
    assert grey_image(image).bytes[0, 0] == round(0.299 * 200)


def test_grey_image_of_a_cut_of_an_image_is_contiguous() -> None:
    image = np.zeros((64, 64), dtype=np.uint8)[::2, ::2]
    assert grey_image(image).bytes.flags.c_contiguous


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_scaled_has_places_where_it_says(scale: float) -> None:
    image = np.repeat(np.arange(0, 240, 4, dtype=np.uint8)[None], 40, axis=0)
    bytes_ = scaled(grey_image(image), scale)
    assert bytes_.shape == (40 * scale, 60 * scale)
    at = np.arange(4, 60 * scale - 4)
    places = (at + 0.5) / scale - 0.5
    np.testing.assert_allclose(bytes_[8, 4:-4], 4 * places, atol=1)


def test_mean_level_is_between_pixels_and_goes_on_beyond_the_rim() -> None:
    image = np.repeat(np.arange(0, 200, 10, dtype=np.uint8)[None], 20, axis=0)
    grey = grey_image(image)
    assert mean_level(grey, np.array([[4.5, 3.0], [6.5, 8.5]])) == pytest.approx(55, abs=0.2)
    assert mean_level(grey, np.array([[-5.0, 3.0]])) == 0
    assert mean_level(grey, np.array([[30.0, 90.0]])) == 190
