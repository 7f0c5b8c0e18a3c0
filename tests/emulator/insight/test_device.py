"""Jobs, images and the device of the emulated In-Sight camera, without sockets."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from smartcam.emulator import Job
from smartcam.emulator._insight.image import bitmap, check_image, grey_pattern
from smartcam.exceptions import ConfigurationError, FrameFormatError
from smartcam.frames._inside import read_bitmap
from smartcam.protocols._inside import StatusCode, words
from tests.emulator.inside import Control, InSightCommands, InSightDevice, cell_text, make_job

SECOND = 1_000_000_000


# ---------------------------------------------------------------------- jobs


def test_job_takes_its_id_from_its_file() -> None:
    assert Job(file="85Test.job").id == 85
    assert Job(file="Test.job").id is None
    assert Job(file="Test.job").is_called("Test")
    assert not Job(file="Test.job").is_called("test")


@pytest.mark.parametrize(
    ("fields", "error"),
    [
        ({}, "job ?: file: Field required"),
        ({"file": ""}, "job : file: String should have at least 1 character"),
        ({"file": " a.job"}, "none blank at its ends"),
        ({"file": "a\n"}, "printable Latin-1"),
        ({"file": "a", "cells": {"AA1": 1, "aa1": 2}}, "cells 'AA1' and 'aa1' are the same"),
        ({"file": "a", "cells": {"A1": 1, "a01": 2}}, "cells 'A1' and 'a01' are the same"),
        ({"file": "a", "cells": {"A400": 1}}, "'A400' is no name of a cell"),
        ({"file": "a", "cells": {"A1": []}}, "cell A1: the list is empty"),
        ({"file": "a", "cells": {"A1": None}}, "cell A1: a cell holds a number or a text"),
        ({"file": "a", "cells": {"A1": [1, "\u20ac"]}}, "cell A1: a text has at most 1024"),
        ({"file": "a", "cells": {"A1": {"kind": "int", "value": 1.5}}}, "a control for int"),
        ({"file": "a", "cells": {"A1": {"kind": "string", "value": 1}}}, "a control for string"),
        (
            {"file": "a", "cells": {"A1": {"kind": "int", "value": 1, "low": 2}}},
            "1 is outside the control's own bounds",
        ),
        ({"file": "a", "cells": 5}, "cells: Input should be a valid dictionary"),
        ({"file": "a", "load_time": -1}, "load_time: Input should be greater than or equal to 0"),
        ({"file": "a", "colour": 1}, "colour: Extra inputs are not permitted"),
    ],
)
def test_job_that_is_wrong_says_where(fields: dict[str, Any], error: str) -> None:
    with pytest.raises(ConfigurationError) as caught:
        make_job(fields)
    assert error in str(caught.value)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1, "1.000"),
        (-0.0005, "-0.001"),
        (True, "1.000"),
        (np.float32(2.5), "2.500"),
        (np.int64(7), "7.000"),
        (float("inf"), "#ERR"),
        (10**400, "#ERR"),
        ("", ""),
        ("a b", "a b"),
    ],
)
def test_shown_writes_numbers_with_three_decimals(value: object, text: str) -> None:
    assert cell_text(value) == text


def test_cell_whose_function_fails_is_in_error(caplog: pytest.LogCaptureFixture) -> None:
    job = Job(file="a", cells={"A1": lambda run: 1 / (run - 1), "B1": lambda _run: object()})
    cells = job.loaded_cells()
    with caplog.at_level(logging.WARNING, "smartcam.emulator"):
        job.update_cells(cells, 1)
    assert cells == {"A001": "#ERR", "B001": "#ERR"}
    assert "cell A001 failed in run 1: ZeroDivisionError" in caplog.text
    job.update_cells(cells, 2)
    assert cells["A001"] == "1.000"


def test_control_admits_what_lies_in_its_bounds() -> None:
    control = Control(kind="float", value=1, low=0, high=2)
    assert control.admits(2)
    assert not control.admits(2.1)
    assert not control.admits(float("nan"))
    assert not control.admits("1")


# ---------------------------------------------------------------------- images


@pytest.mark.parametrize(
    ("image", "error"),
    [
        (np.zeros((2, 2)), "an image is a 2-D array of uint8, got 2 axes of float64"),
        (np.zeros(4, np.uint8), "an image is a 2-D array of uint8, got 1 axes of uint8"),
        (np.zeros((0, 4), np.uint8), "an image has 1 to 8388608 pixels, got 0"),
        (np.zeros((4000, 4000), np.uint8), "an image has 1 to 8388608 pixels, got 16000000"),
    ],
)
def test_image_that_is_no_grey_picture_is_refused(image: object, error: str) -> None:
    with pytest.raises(ConfigurationError, match=error):
        check_image(image)


def test_pattern_shows_which_way_round_it_is() -> None:
    image = grey_pattern()
    assert image.shape == (48, 64)
    assert image[0, 0] == 0
    assert image[0, -1] > image[-1, 0] > 0
    assert len(bitmap(image)) == 54 + 1024 + 48 * 64


def test_device_keeps_its_own_copy_of_an_image() -> None:
    image = np.zeros((2, 2), np.uint8)
    device = InSightDevice(image=image)
    image[0, 0] = 9
    assert device.image[0, 0] == 0


# ---------------------------------------------------------------------- the device


@pytest.mark.parametrize(
    ("jobs", "error"),
    [
        ([{"file": "a.job"}, {"file": "a.job"}], "job a.job: there are two of that name"),
        ([{"file": "1a"}, {"file": "01b"}], "jobs 1a and 01b have the same id, 1"),
    ],
)
def test_jobs_that_cannot_be_told_apart_are_refused(jobs: list[dict[str, Any]], error: str) -> None:
    with pytest.raises(ConfigurationError, match=error):
        InSightDevice(jobs)


def test_active_job_is_the_first_or_the_one_that_is_named() -> None:
    jobs = [Job(file="a.job"), Job(file="b.job")]
    assert InSightDevice(jobs).job is jobs[0]
    assert InSightDevice(jobs, active="b").job is jobs[1]
    with pytest.raises(
        ConfigurationError, match=r"job 'c' is not on the camera; there are: a\.job"
    ):
        InSightDevice(jobs, active="c")


def test_things_happen_in_order_each_at_its_own_time() -> None:
    device = InSightDevice([Job(file="a", acquisition_time=0.25, processing_time=0.5)], online=True)
    told: list[tuple[int, StatusCode]] = []
    device.request_event(8, lambda code: told.append((device.now, code)), after_image=False)
    device.after(0.5, lambda: told.append((device.now, StatusCode.UNRECOGNIZED)))
    assert device.next_event_at == SECOND // 4
    device.advance_to(10 * SECOND)
    assert told == [(SECOND // 2, 0), (3 * SECOND // 4, 1)]
    assert device.next_event_at is None
    device.advance_to(SECOND)
    assert device.now == 10 * SECOND


@pytest.mark.parametrize("tenths", [0, 1])
def test_run_is_broken_off_when_the_camera_goes_offline_and_tells_once(tenths: int) -> None:
    job = Job(file="a", acquisition_time=0.1, processing_time=0.1)
    device = InSightDevice([job], online=True)
    told: list[StatusCode] = []
    device.request_event(8, told.append, after_image=False)
    device.advance_to(tenths * SECOND // 10)
    assert device.busy
    device.set_online(False)
    device.advance_to(SECOND)
    assert told == [StatusCode.FAILED]
    assert (device.runs, device.busy) == (0, False)


def test_operator_s_word_is_kept_when_a_client_asks_for_online() -> None:
    device = InSightDevice()
    device.set_online(False)
    assert device.request_online(True) == StatusCode.STILL_OFFLINE
    device.set_online(True)
    assert device.online
    assert device.request_online(False) == StatusCode.DONE
    assert not device.online


# ---------------------------------------------------------------------- commands

LINES = st.builds(
    "".join,
    st.tuples(
        st.sampled_from([*words.COMMANDS, *map(str.lower, words.COMMANDS), "QQ"]),
        st.sampled_from(
            ["", "0", "1", "8", "7", "A001", "B0025", "C0031.5", "D004", "name 5", "a"]
        ),
        st.text(st.characters(max_codepoint=255), max_size=8),
    ),
)


@given(st.lists(LINES, max_size=20), st.booleans())
@example(lines=["SSD004\x1f"], online=False)
@example(lines=["SSD004" + "x" * 2000], online=False)
def test_every_line_has_exactly_one_answer(lines: list[str], online: bool) -> None:
    cells = {
        "A1": [1, 2],
        "B2": Control(kind="int", value=1),
        "C3": Control(kind="float", value=1),
        "D4": Control(kind="string", value=""),
        "Name": Control(kind="int", value=1),
    }
    device = InSightDevice([Job(file="7a.job", cells=cells), Job(file="a.job")], online=online)
    commands = InSightCommands(device, evaluations={"A001": "x"})
    for line in lines:
        said: list[tuple[bytes, bool]] = []
        commands.execute(line, lambda data, *, more=False, said=said: said.append((data, more)))
        device.advance_to(device.now + 10 * SECOND)
        assert [more for _, more in said] == [True] * (len(said) - 1) + [False]
        first = said[0][0].split(b"\r\n")[0]
        assert int(first) in {code.value for code in StatusCode}
        assert said[-1][0].endswith(b"\r\n")
        assert not device.busy


@given(st.integers(1, 9), st.integers(1, 9), st.integers(0, 1 << 30))
def test_grey_bitmap_comes_back(width: int, height: int, seed: int) -> None:
    pixels = np.random.default_rng(seed).integers(0, 256, (height, width)).astype(np.uint8)
    data = bitmap(pixels)
    assert (read_bitmap(data) == pixels).all()
    for length in (0, 20, 53, len(data) - 1):
        with pytest.raises(FrameFormatError):
            read_bitmap(data[:length])
