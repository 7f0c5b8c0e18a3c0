"""smartcam in ROS 1 as programs of other people see it: Debian's rospy, in a network namespace.

rospy listens on all interfaces, so everything runs in a namespace of its own. In place of our small
bridge another one may be run by hand: see in_namespace.py.
"""

import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.ros1.in_namespace import PYTHON

pytestmark = pytest.mark.long

PACKAGES = (
    "python3-rosmaster python3-rospy python3-genpy python3-std-srvs python3-sensor-msgs "
    "python3-diagnostic-msgs ros-std-msgs ros-geometry-msgs"
)
MODULES = "rosmaster, rospy, genpy, std_srvs.srv, sensor_msgs.msg, diagnostic_msgs.msg"
ABORTED = (
    "responded with an error: b'service cannot process request: service handler returned None'"
)


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The messages that were seen in the namespace."""
    files = ("std_msgs/msg/Header.msg", "geometry_msgs/msg/PoseStamped.msg")
    there = Path(PYTHON).exists() and all(Path("/usr/share", one).exists() for one in files)
    imports = [PYTHON, "-c", f"import {MODULES}"]
    if not there or subprocess.run(imports, capture_output=True, check=False).returncode:  # noqa: S603
        pytest.skip(f"needs Debian's ROS 1: apt-get install {PACKAGES}")
    if shutil.which("ip") is None or shutil.which("unshare") is None:
        pytest.skip("needs ip and unshare: apt-get install iproute2 util-linux")
    if importlib.util.find_spec("zenoh") is None:
        pytest.skip("needs the extra ros2")
    for namespace in (["unshare", "-n"], ["unshare", "-r", "-n"]):
        if not subprocess.run([*namespace, "true"], capture_output=True, check=False).returncode:  # noqa: S603
            break
    else:
        pytest.skip("needs network namespaces: unshare -n is not allowed here")
    folder = tmp_path_factory.mktemp("ros1")
    done = subprocess.run(  # noqa: S603
        [*namespace, sys.executable, "-m", "tests.ros1.in_namespace", str(folder)],
        capture_output=True,
        check=False,
        timeout=300,
        cwd=Path(__file__).parents[2],
    )
    logs = "".join(f"\n{one.name}: {one.read_text()[-3000:]}" for one in folder.glob("*.log"))
    assert done.returncode == 0, done.stderr.decode() + logs
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_topics(seen: dict[str, Any]) -> None:
    topics = seen["topics"]
    assert topics["text"] == {"data": "grün"}
    assert topics["info"]["header"] == {"seq": 1, "stamp": [1_700_000_000, 5], "frame_id": "f"}
    assert topics["info"]["K"] == [*range(9)]
    assert (topics["info"]["D"], topics["info"]["width"]) == ([0.5], 640)
    assert topics["picture"] is True


def test_services(seen: dict[str, Any]) -> None:
    services = seen["services"]
    assert services["works"] == {"success": True, "message": "grün"}
    assert services["refuses"] == {"success": False, "message": "not running"}
    assert services["empty"] == {}
    assert services["fails"] == f"ServiceException: service [/probe/fails] {ABORTED}"


def test_nobody_gets_the_answer_to_another_where_the_way_to_the_bridge_breaks(
    seen: dict[str, Any],
) -> None:
    cut = seen["cut"]
    aborted = f"ServiceException: service [/probe/slow] {ABORTED}"
    assert cut["old"] == aborted
    # it may come when the way is there again, and has the answer to itself then
    assert cut["late"] in (aborted, {"success": True, "message": "call 2"})
    assert cut["new"] == {"success": True, "message": f"call {cut['calls']}"}
    assert cut["text"] == {"data": "grün"}


def test_cameras(seen: dict[str, Any]) -> None:
    cameras = seen["cameras"]
    status = cameras["status"]
    assert (status["camera_name"], status["connected"]) == ("line1/cam3", True)
    assert cameras["run"]["success"] is True
    localized = cameras["localized"]
    assert localized["error"] == ""
    found = localized["localizations"]
    assert found[0]["feature_id"] == "big_triangle_1"
    assert found[0]["pose"]["header"]["frame_id"] == "line1_cam3"
    assert len(found) == len(cameras["poses"]["poses"]) == 7
    assert "this is the node of 'line1/cam3'" in cameras["other"]["error"]
    assert {one["name"] for one in cameras["diagnostics"]["status"]} & {
        "line1/cam3: camera",
        "cam4: camera",
    }
    graph = cameras["graph"]
    assert {"/line1/cam3/results", "/cam4/status", "/diagnostics"} <= {*graph["topics"]}
    assert {"/line1/cam3/TriggerLocalization", "/cam4/trigger"} <= {*graph["services"]}
    absent = ("lifecycle", "change_state", "list_parameters", "transition", "detections")
    assert not [one for one in (*graph["topics"], *graph["services"]) if one.endswith(absent)]


def test_a_front_end_in_rospy_calibrates_a_plane(seen: dict[str, Any]) -> None:
    done = seen["cameras"]["calibrated"]
    assert set(done["errors"]) == {""}
    titles = done["titles"]
    assert titles[:3] == ["Calibration", "Camera, robot and tool", "Marks in the camera's field"]
    assert [one for one in titles if one.startswith("Touch mark")][-1] == "Touch mark 7 of 7"
    assert titles[-2:] == ["What came out", "Save table"]
    assert "table.json" in done["text"]
    pose = done["pose"]["pose"]
    assert (done["pose"]["error"], pose["header"]["frame_id"]) == ("", "base")
    place = pose["pose"]["position"]
    assert abs(place["x"] - 1.05) < 1e-3
    assert abs(place["y"] - 0.02) < 1e-3
    assert abs(place["z"] - 0.5) < 1e-3
    assert done["exported"] == {"error": ""}
    assert "cannot be used" in done["refused"]["error"]
    assert {"table.json", "table.journal", "exports"} <= {*seen["files"]}


def test_bridges_come_and_go(seen: dict[str, Any]) -> None:
    before, after = seen["lines"][:2], seen["lines"][2:]
    assert [one["node"] for one in before] == ["/cam4", "/line1/cam3"]
    assert not any(one["connected"] for one in before)
    assert all("no rosbridge" not in one["reason"] and one["reason"] for one in before)
    assert {one["node"] for one in after} == {"/cam4", "/line1/cam3"}
    assert all(one["connected"] for one in after)
    assert seen["again"] == {"success": True, "message": "grün"}
    assert seen["camera again"]["success"] is True


def test_nothing_is_left(seen: dict[str, Any]) -> None:
    assert seen["code"] == 0
    assert not [one for one in seen["left"] if not one.startswith(("/peer/", "/bridge/"))]
