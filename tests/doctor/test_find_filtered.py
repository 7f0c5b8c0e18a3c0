"""Test a search in a network namespace that drops, prohibits or has no way for packets."""

from __future__ import annotations

import asyncio
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import smartcam
from smartcam.doctor._inside import CameraSearch
from smartcam.emulator import EmulatedCamera

pytestmark = pytest.mark.long

DEVICE = "swallows"
"""Name of a network device that drops all packets, like a firewall."""

PORT_COUNT = 6
"""Number of ports of the known protocols, which a search opens."""

SET_UP = (
    ("link", "set", "lo", "up"),
    ("link", "add", DEVICE, "type", "ifb"),
    ("link", "set", DEVICE, "up"),
    ("address", "add", "10.77.0.1/24", "dev", DEVICE),
    ("-6", "address", "add", "fd77::1/64", "dev", DEVICE, "nodad"),
    ("route", "add", "unreachable", "10.77.1.0/24"),
    ("route", "add", "prohibit", "10.77.2.0/24"),
)


async def _search() -> dict[str, object]:
    """Search in the namespace; return the results."""
    async with (
        EmulatedCamera(host="10.77.0.1", port=36701, active=21, running=True) as emulator,
        smartcam.connect(emulator.url, reconnect=None) as client,
    ):
        networks = ["10.77.0.0/28", "fd77::2", "10.77.1.1-2", "10.77.2.1-3", "10.99.0.1"]
        search = CameraSearch(networks, ports=[5000], may_disturb=True, rate=1000, timeout=0.5)
        task = asyncio.create_task(search.run())
        while not task.done():
            await client.trigger()
        await task
        statistics = client.statistics()
        return {
            "found": [(one.host, one.protocols) for one in search.results()],
            "counts": search.counts,
            "why": search.failure,
            "lost": statistics.received - statistics.triggered,
            "sessions": statistics.sessions,
        }


def test_search_ends_where_packets_are_dropped() -> None:
    if shutil.which("ip") is None or shutil.which("unshare") is None:
        pytest.skip("needs ip and unshare: apt-get install iproute2 util-linux")
    for namespace in (["unshare", "-n"], ["unshare", "-r", "-n"]):
        probe = [*namespace, "ip", "link", "add", DEVICE, "type", "ifb"]
        if not subprocess.run(probe, capture_output=True, check=False).returncode:  # noqa: S603
            break
    else:
        pytest.skip("needs network namespaces: unshare -n is not allowed here, or has no ifb")
    done = subprocess.run(  # noqa: S603
        [*namespace, sys.executable, "-m", "tests.doctor.test_find_filtered"],
        capture_output=True,
        check=False,
        timeout=120,
        cwd=Path(__file__).parents[2],
    )
    assert done.returncode == 0, done.stderr.decode()
    found = json.loads(done.stdout)
    why = found.pop("why")
    assert found == {
        "found": [["10.77.0.1", ["bvs"]]],
        # one of the ports is the camera's, where it is at home; nobody has the others
        "counts": {
            "open": 1,
            "refused": PORT_COUNT - 1,
            "no answer": PORT_COUNT * 13 + PORT_COUNT,
            "unreachable": PORT_COUNT * 2 + PORT_COUNT,
            "failed": PORT_COUNT * 3,
        },
        "lost": 0,
        "sessions": 1,
    }
    assert why == "Permission denied"


if __name__ == "__main__":
    for arguments in SET_UP:
        subprocess.run(["ip", *arguments], check=True)  # noqa: S603, S607
    print(json.dumps(asyncio.run(_search())))  # noqa: T201 - this is how the parent hears of it
