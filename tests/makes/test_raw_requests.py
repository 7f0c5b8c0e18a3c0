"""Test a user's own requests: each has an answer or a typed error, and the session goes on."""

from __future__ import annotations

from typing import Any

import pytest

import smartcam
from smartcam.exceptions import (
    CommandRejectedError,
    ConfigurationError,
    LocalProtocolError,
    SmartCamError,
    UnsupportedError,
)
from smartcam.makes import EmulatedIfm, EmulatedIv3, EmulatedSr

IFM = {
    "T?": b"star;12.5000;-3.0000;0.9700;stop",
    "t": ConfigurationError,
    "A?": b"002\t01\t01\t02",
    "a02": b"*",
    "a77": CommandRejectedError,
    "p0": b"*",
    "S": UnsupportedError,
    "C?": None,
    "v02": ConfigurationError,
    "c000000002{}": CommandRejectedError,
    "\r\nT?": ConfigurationError,
    "": ConfigurationError,
}
LINES: dict[str, tuple[Any, dict[str, Any]]] = {
    "pcic v3": (lambda: EmulatedIfm(version=3), IFM),
    "pcic v4": (lambda: EmulatedIfm(version=4), {**IFM, "T?": LocalProtocolError}),
    "pcic v2": (lambda: EmulatedIfm(version=2), {**IFM, "I02?": UnsupportedError}),
    "pcic v1": (
        lambda: EmulatedIfm(version=1),
        {**IFM, "T?": LocalProtocolError, "H?": UnsupportedError},
    ),
    "iv3": (
        EmulatedIv3,
        {
            "T2": LocalProtocolError,
            "T1": b"T1",
            "RT": None,
            "PR": b"PR,000",
            "PW,1": b"PW",
            "PW,99": CommandRejectedError,
            "XX": UnsupportedError,
            "T1\rT2": ConfigurationError,
        },
    ),
    "sr": (
        EmulatedSr,
        {
            "LON": LocalProtocolError,
            "LON,05": LocalProtocolError,
            "LOFF": LocalProtocolError,
            "NUM": None,
            "BUSYSTAT": b"OK,BUSYSTAT,NONE",
            "ERRSTAT": b"OK,ERRSTAT,NONE",
            "XX": UnsupportedError,
            "BCLR": b"OK,BCLR",
        },
    ),
}
"""Lines by camera, each with the expected answer or error; None for any bytes."""

CASES = [(name, line) for name, (_, lines) in LINES.items() for line in lines]


@pytest.mark.parametrize(("name", "line"), CASES)
@pytest.mark.asyncio
async def test_line_by_hand_is_answered_or_refused_and_the_session_goes_on(
    name: str, line: str
) -> None:
    make, lines = LINES[name]
    expected = lines[line]
    async with make() as emulator, smartcam.connect(emulator.url, request_timeout=5.0) as camera:
        if isinstance(expected, bytes | None):
            found = await camera.request(line)
            assert found is not None
            assert expected is None or found == expected
        else:
            with pytest.raises(expected):
                await camera.request(line)
        try:
            await camera.trigger()
        except smartcam.WrongApplicationError:
            assert line in {"a02", "PW,1"}
            await camera.trigger()
        account = camera.statistics()
        assert (account.sessions, account.triggered) == (1, 1)


@pytest.mark.asyncio
async def test_layout_of_the_session_is_not_changed_by_hand() -> None:
    async with (
        EmulatedIfm() as emulator,
        smartcam.connect(emulator.url, interpret_as="x: real32") as camera,
    ):
        with pytest.raises(ConfigurationError, match="that of interpret_as: x: real32"):
            await camera.request("c000000002{}")
        assert (await camera.trigger()).value.x == pytest.approx(12.5)


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.asyncio
async def test_version_without_lengths_reads_no_pictures(version: int) -> None:
    async with EmulatedIfm(version=version) as emulator, smartcam.connect(emulator.url) as camera:
        assert not camera.capabilities.read_image
        with pytest.raises(UnsupportedError):
            await camera.read_image()
        assert (await camera.trigger()).raw.startswith(b"star")


@pytest.mark.parametrize("name", LINES)
@pytest.mark.asyncio
async def test_line_by_hand_that_is_not_waited_for_leaves_the_next_answer_its_own(
    name: str,
) -> None:
    make, lines = LINES[name]
    async with make() as emulator, smartcam.connect(emulator.url) as camera:
        for line, expected in lines.items():
            if expected is not None and not isinstance(expected, bytes):
                continue
            try:
                await camera.request(line, answered=False)
            except SmartCamError as error:
                pytest.fail(f"{line}: {error!r}")
        assert await camera.query_application() in {0, 1, 2, -1}
        assert camera.statistics().sessions == 1
