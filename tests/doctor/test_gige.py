"""Test the doctor for GigE cameras in each situation that people ask about.

The situations are the most frequent ones in the issues of pypylon and harvesters.
"""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import pytest

from smartcam.doctor import examine
from smartcam.exceptions import ConfigurationError
from tests.frames.gige.camera import DESCRIPTION, Mischief, camera
from tests.processes import network_namespace

if TYPE_CHECKING:
    from collections.abc import Callable

    from smartcam.doctor._inside import Finding
    from tests.frames.gige.camera import Camera

T = TypeVar("T")

PYPYLON = "https://github.com/basler/pypylon/issues/"
HARVESTERS = "https://github.com/genicam/harvesters/issues/"

ISSUES: dict[str, tuple[str, ...]] = {
    "the buffer was incompletely grabbed": (
        *(f"{PYPYLON}{number}" for number in (370, 446, 589, 597, 734)),
        f"{HARVESTERS}131",
    ),
    "grabs time out, although the camera can be set": (
        *(f"{PYPYLON}{number}" for number in (452, 493)),
        *(f"{HARVESTERS}{number}" for number in (348, 418)),
    ),
    "no trigger comes": (f"{PYPYLON}752", f"{HARVESTERS}354"),
    "controlled by another application": (
        *(f"{PYPYLON}{number}" for number in (186, 202, 369, 776)),
        "https://github.com/motmot/libcamiface/issues/14",
    ),
    "another subnet": (
        f"{PYPYLON}698",
        f"{HARVESTERS}333",
        "https://github.com/AravisProject/aravis/issues/90",
        "https://github.com/basler/pylon-ros-camera/issues/48",
    ),
    "no device is found": (
        *(f"{PYPYLON}{number}" for number in (379, 834)),
        *(f"{HARVESTERS}{number}" for number in (216, 265)),
    ),
    "one picture, and no more": tuple(f"{HARVESTERS}{number}" for number in (148, 365)),
    "small pictures come, large ones do not": (f"{PYPYLON}597", f"{HARVESTERS}210"),
    "timeouts at a low frame rate": (f"{PYPYLON}857",),
    "several cameras, or a fast one, on a thin link": (f"{PYPYLON}589", f"{HARVESTERS}365"),
}
"""Issues by the situation that they describe; a test below is marked with each situation."""


TESTED_SITUATIONS: set[str] = set()


def mark_situation(situation: str) -> Callable[[T], T]:
    """Mark a test with the situation that it tests."""
    TESTED_SITUATIONS.add(situation)
    return lambda test: test


def integer_feature(name: str, address: int) -> str:
    """Return the description of an integer feature at an address of memory."""
    return (
        f'<Integer Name="{name}"><pValue>{name}Word</pValue></Integer>'
        f'<IntReg Name="{name}Word"><Address>{address:#x}</Address><Length>4</Length>'
        "<AccessMode>RW</AccessMode><pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>"
    )


def enumeration_feature(name: str, address: int, *entries: str) -> str:
    """Return the description of an enumeration at an address of memory."""
    told = "".join(
        f'<EnumEntry Name="{entry}"><Value>{number}</Value></EnumEntry>'
        for number, entry in enumerate(entries)
    )
    register = (
        f'<IntReg Name="{name}Word"><Address>{address:#x}</Address><Length>4</Length>'
        "<AccessMode>RW</AccessMode><pPort>Device</pPort><Endianess>BigEndian</Endianess></IntReg>"
    )
    return f'<Enumeration Name="{name}">{told}<pValue>{name}Word</pValue></Enumeration>{register}'


MODE, MODE_TRIGGER, TRIGGER_SOURCE, LINK_SPEED = 0x12000, 0x12004, 0x12008, 0x1200C


def described(*features: str) -> bytes:
    """Return a camera description with further features, unless it has them."""
    missing = [one for one in features if one.split('"')[1] not in DESCRIPTION]
    return DESCRIPTION.replace(
        '<Port Name="Device"/>', f'{"".join(missing)}<Port Name="Device"/>'
    ).encode()


TRIGGERED = described(
    enumeration_feature("TriggerMode", MODE_TRIGGER, "Off", "On"),
    enumeration_feature("TriggerSource", TRIGGER_SOURCE, "Software", "Line1"),
)


async def examined(device: Camera, query: str = "", seconds: float = 0.6) -> list[Finding]:
    url = f"gige://127.0.0.1:{device.port}?{query}"
    return [finding async for finding in examine(url, seconds=seconds)]


def finding_of(findings: list[Finding], check: str) -> Finding:
    """Return the last finding of a check."""
    return [one for one in findings if one.check == check][-1]


async def test_camera_that_is_well_is_told_so_and_given_back() -> None:
    async with camera() as device:
        findings = await examined(device)
        assert device.owner is None
        assert not device.streaming
    assert [one.check for one in findings if one.severity not in ("ok", "hint")] == []
    stream = finding_of(findings, "stream")
    assert stream.details["lost"] == stream.details["requested"] == 0
    assert stream.details["frames"] > 5
    assert finding_of(findings, "packet size").details["packet_size"] == 1500


@mark_situation("the buffer was incompletely grabbed")
async def test_lost_packets_are_counted_and_the_cures_are_named() -> None:
    mischief = Mischief(drop=0.1, resend="ignore", seed=3)
    async with camera(mischief=mischief, test_packets=0) as device:
        found = finding_of(await examined(device, seconds=1.0), "stream")
    assert found.severity == "warning"
    assert found.details["lost"] > 0
    assert f"{found.details['lost']} more lost for missing packets" in found.text
    for cure in ("MTU of 9000", "rmem_max", "GevSCPD", "cable"):
        assert cure in found.cure


async def test_packets_that_came_again_lose_no_picture() -> None:
    async with camera(mischief=Mischief(drop=0.03, seed=1), test_packets=0) as device:
        found = finding_of(await examined(device, seconds=1.0), "stream")
    assert found.severity in ("hint", "warning")  # one that is lost three times is lost
    assert found.details["requested"] > found.details["lost"]


@mark_situation("grabs time out, although the camera can be set")
async def test_stream_that_is_dropped_whole_is_a_firewall() -> None:
    async with camera(mischief=Mischief(drop=1.0), test_packets=0) as device:
        findings = await examined(device)
    found = findings[-1]
    assert (found.check, found.severity, found.exit_code) == ("stream", "error", 4), found
    assert "no packet of the stream came" in found.text
    assert "firewall" in found.cure


@mark_situation("no trigger comes")
async def test_camera_that_waits_for_a_trigger_says_which() -> None:
    silent = Mischief(drop=1.0)
    async with camera(description=TRIGGERED, mischief=silent, test_packets=0) as device:
        device.words.update({MODE_TRIGGER: 0, TRIGGER_SOURCE: 1})
        findings = await examined(device, "feature.TriggerMode=On&feature.TriggerSource=Line1")
    found = findings[-1]
    assert (found.check, found.severity, found.exit_code) == ("trigger", "error", 4)
    assert "TriggerMode is On" in found.text
    assert "by Line1" in found.text
    assert "no trigger came in" in found.text
    assert "?feature.TriggerMode=Off" in found.cure


@mark_situation("controlled by another application")
async def test_camera_of_another_application_says_whose_it_is_and_is_left_alone() -> None:
    async with camera() as device:
        device.take_away("192.168.3.4")
        device.words[0xA00] = 2
        findings = await examined(device)
    found = findings[-1]
    assert (found.check, found.severity, found.exit_code) == ("control", "error", 3)
    assert "another application at 192.168.3.4 controls it" in found.text
    assert "heartbeat" in found.cure
    assert device.sent == []


@mark_situation("no device is found")
async def test_camera_that_no_search_finds_is_reported_with_what_there_is() -> None:
    findings = [one async for one in examine("gige://?serial=NOBODY", seconds=0.5)]
    (found,) = findings
    assert (found.check, found.severity, found.exit_code) == ("address", "error", 3)
    assert "serial number NOBODY, found 0" in found.text
    assert "firewall" in found.cure


@mark_situation("no device is found")
async def test_address_at_which_nobody_answers_is_told() -> None:
    async with camera(deaf=True) as device:
        found = (await examined(device))[-1]
    assert (found.check, found.severity, found.exit_code) == ("answers", "error", 3)
    assert "nothing answers at 127.0.0.1" in found.text
    assert "UDP port 3956" in found.cure


async def test_host_that_is_no_camera_is_reported() -> None:
    async with camera() as device:
        port = device.port
    found = [one async for one in examine(f"gige://127.0.0.1:{port}", seconds=0.5)][-1]
    assert found.check == "answers"
    assert f"nothing listens at UDP port {port}" in found.text


@mark_situation("one picture, and no more")
async def test_camera_that_is_set_to_a_single_picture_is_reported() -> None:
    modes = enumeration_feature("AcquisitionMode", MODE, "Continuous", "SingleFrame")
    async with camera(description=described(modes)) as device:
        device.words[MODE] = 1
        findings = await examined(device)
        assert device.words[MODE] == 0
    found = finding_of(findings, "features")
    assert found.severity == "hint"
    assert "AcquisitionMode is SingleFrame" in found.text
    assert finding_of(findings, "stream").severity == "ok"


@mark_situation("timeouts at a low frame rate")
async def test_slow_camera_is_reported_by_how_much_the_wait_is_too_short() -> None:
    async with camera() as device:
        findings = await examined(device, "fps=0.125")
    found = findings[-1]
    assert found.severity == "warning"
    assert "one is due each 8 s" in found.text
    assert "--seconds 24" in found.cure


@mark_situation("several cameras, or a fast one, on a thin link")
async def test_stream_that_does_not_fit_the_link_is_reported_with_the_rate_that_fits() -> None:
    speed = integer_feature("DeviceLinkSpeed", LINK_SPEED)
    async with camera(description=described(speed), test_packets=0) as device:
        device.words[LINK_SPEED] = 100_000  # bytes a second; 64x48 at 100/s want 307,200
        findings = await examined(device)
    found = finding_of(findings, "link")
    assert (found.severity, found.exit_code) == ("error", 5)
    assert "it does not fit" in found.text
    most = float(found.cure.partition("fps=")[2].split()[0])
    assert 25 < most < 30  # 100,000 * 0.9 / 3072


async def test_options_of_smart_cameras_are_refused() -> None:
    for options in ({"trigger": True}, {"application": 5}, {"interpret_as": "raw"}):
        with pytest.raises(ConfigurationError, match="a GigE camera has no applications"):
            await anext(examine("gige://127.0.0.1", **options))
    with pytest.raises(ConfigurationError, match="unknown parameter 'fbs'"):
        await anext(examine("gige://127.0.0.1?fbs=3"))


async def test_cancelled_examination_gives_the_camera_back() -> None:
    async with camera() as device:
        running = asyncio.create_task(examined(device, seconds=600))
        async with asyncio.timeout(60):
            while not device.streaming or not device.sent:  # noqa: ASYNC110 - it is another's
                await asyncio.sleep(0.01)
        running.cancel()
        await asyncio.wait([running])
        assert running.cancelled()
        assert device.owner is None
        assert not device.streaming


# ---------------------------------------------------------------------- with a network of its own


@pytest.fixture(scope="module")
def namespace() -> list[str]:
    """Return a command that runs another command in a network namespace."""
    return network_namespace("arv-fake-gv-camera-0.8", "aravis-tools")


def findings_in_namespace(namespace: list[str], situation: str) -> list[dict[str, Any]]:
    """Return the findings about Aravis's fake camera in a situation."""
    done = subprocess.run(  # noqa: S603
        [*namespace, sys.executable, "-m", "tests.doctor.gige_in_namespace", situation],
        capture_output=True,
        check=False,
        timeout=120,
        cwd=Path(__file__).parents[2],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert done.returncode == 0, done.stderr.decode()
    found: list[dict[str, Any]] = json.loads(done.stdout)
    return found


def last(findings: list[dict[str, Any]], check: str) -> dict[str, Any]:
    return [one for one in findings if one["check"] == check][-1]


@pytest.mark.long
def test_camera_of_others_is_examined(namespace: list[str]) -> None:
    findings = findings_in_namespace(namespace, "well")
    assert [one for one in findings if one["severity"] in ("warning", "error")] == []
    assert "no program controlled it" in last(findings, "control")["text"]


@pytest.mark.long
@mark_situation("no trigger comes")
def test_camera_of_others_waits_for_a_trigger(namespace: list[str]) -> None:
    found = findings_in_namespace(namespace, "trigger")[-1]
    assert found["check"] == "trigger"
    assert "TriggerMode is On" in found["text"]


@pytest.mark.long
@mark_situation("small pictures come, large ones do not")
def test_packets_above_the_mtu_are_reported(namespace: list[str]) -> None:
    found = last(findings_in_namespace(namespace, "mtu"), "packet size")
    assert found["severity"] in ("warning", "error")
    assert "packets of 8000 bytes" in found["text"]
    assert "1500 (MTU)" in found["text"]
    assert "packet_size=1500" in found["cure"]


@pytest.mark.long
@mark_situation("another subnet")
def test_camera_of_another_subnet_is_reported(namespace: list[str]) -> None:
    findings = findings_in_namespace(namespace, "subnet")
    found = last(findings, "subnet")
    assert found["severity"] == "warning"
    assert "198.51.100.7 is of another subnet than this machine" in found["text"]
    assert "10.9.8.1 in 10.9.8.0/24" in found["text"]
    assert "ForceIP" in found["cure"]
    assert "no route to the camera" in findings[-1]["text"]


@pytest.mark.long
@mark_situation("another subnet")
def test_two_networks_alike_are_reported(namespace: list[str]) -> None:
    found = last(findings_in_namespace(namespace, "twice"), "subnet")
    assert found["severity"] == "warning"
    assert "is of 2 networks of this machine" in found["text"]


def test_each_situation_has_a_test() -> None:
    assert ISSUES.keys() == TESTED_SITUATIONS
    assert len(ISSUES) >= 8
    assert all(one.startswith("https://github.com/") for urls in ISSUES.values() for one in urls)
