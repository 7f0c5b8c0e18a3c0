"""Examine Aravis's fake camera in a situation; test_gige.py runs this in a network namespace.

``python -m tests.doctor.gige_in_namespace SITUATION`` prints the findings as JSON.
"""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys

import smartcam.frames
from smartcam.doctor import examine
from tests.frames.gige.in_namespace import PROGRAM

URLS = {
    "well": "gige://127.0.0.1?fps=20",
    "trigger": "gige://127.0.0.1?feature.TriggerMode=On&feature.TriggerSource=Software",
    "mtu": "gige://127.0.0.1?fps=20&packet_size=8000",
    "subnet": "gige://198.51.100.7",
    "twice": "gige://10.9.8.7",
}

SETTINGS = {
    "mtu": ("ip link set lo mtu 1500",),
    "subnet": (
        "ip link add one type veth peer name other",
        "ip address add 10.9.8.1/24 dev one",
        "ip link set one up",
    ),
    "twice": (
        "ip link add one type veth peer name other",
        "ip address add 10.9.8.1/24 dev one",
        "ip address add 10.9.8.2/24 dev other",
        "ip link set one up",
        "ip link set other up",
    ),
}


async def findings(situation: str) -> list[dict[str, object]]:
    if situation not in ("subnet", "twice"):
        async with asyncio.timeout(30):
            while not await smartcam.frames.discover("gige"):
                pass
    for line in SETTINGS.get(situation, ()):
        subprocess.run(line.split(), check=True)  # noqa: ASYNC221, S603
    return [
        {"check": one.check, "severity": one.severity, "text": one.text, "cure": one.cure}
        async for one in examine(URLS[situation], seconds=1.0)
    ]


def main() -> None:
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)  # noqa: S607
    fake = subprocess.Popen(  # noqa: S603
        [PROGRAM, "-i", "127.0.0.1", "-s", "FAKE01"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        print(json.dumps(asyncio.run(findings(sys.argv[1]))))  # noqa: T201
    finally:
        fake.terminate()
        fake.wait(10)


if __name__ == "__main__":
    main()
