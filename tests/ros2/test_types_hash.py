"""Type hashes compared with ROS' own generator, and the package's files with the built-in texts."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from rosbags.typesys import Stores, get_typestore

from smartcam.models import Status
from smartcam.ros2 import RosTypes
from smartcam.ros2._types.built_in.smartcam import SMARTCAM_MSGS
from tests.ros2.typekit import add_test_msgs

GOLDEN: list[dict[str, Any]] = json.loads(
    (Path(__file__).parent / "golden" / "hashes.json").read_text()
)
PACKAGE = Path(__file__).parents[2] / "ros2" / "smartcam_msgs"
WITH_HASHES = ("jazzy", "kilted", "lyrical", "rolling")

OURS: dict[str, str] = GOLDEN[-1]["hashes"]
"""A change here is a change of the interface: clients that were built before will not be heard."""


def hash_of(types: RosTypes, name: str) -> str:
    """Return the hash of a message, of a service, or of one of its three messages."""
    if "/msg/" in name:
        return types.message(name).hash
    if name.endswith(("_Request", "_Response", "_Event")):
        service, _, part = name.rpartition("_")
        found: str = getattr(types.service(service), part.lower()).hash
        return found
    return types.service(name).hash


@pytest.mark.parametrize("golden", GOLDEN, ids=range(len(GOLDEN)))
def test_hashes_are_those_of_ros(golden: dict[str, Any]) -> None:
    types = RosTypes(golden["distribution"])
    add_test_msgs(types)
    assert golden["source"]
    got = {name: hash_of(types, name) for name in golden["hashes"]}
    assert got == golden["hashes"]


def test_golden_hashes_have_what_we_use() -> None:
    known = {name for golden in GOLDEN for name in golden["hashes"]}
    services = {name for name in RosTypes("lyrical").names() if "/srv/" in name}
    assert services <= known
    assert set(SMARTCAM_MSGS) <= known
    assert {name.partition("/")[0] for name in known} >= {
        *("diagnostic_msgs", "geometry_msgs", "lifecycle_msgs", "rcl_interfaces", "sensor_msgs"),
        *("std_msgs", "std_srvs", "stereo_msgs", "tf2_msgs", "type_description_interfaces"),
        "vision_msgs",
    }


@pytest.mark.parametrize("distribution", WITH_HASHES)
def test_hashes_are_those_of_rosbags(distribution: str) -> None:
    """Another implementation; it takes ``char`` for a type of its own, which it is not in ROS."""
    newest = "lyrical" if distribution == "rolling" else distribution
    store = get_typestore(Stores(f"ros2_{newest}"))
    types = RosTypes(distribution)
    names = [name for name in store.fielddefs if "char" not in str(_all(store.fielddefs, name))]
    assert len(names) > 150
    got = {name: types.message(name).hash for name in names}
    assert got == {name: store.hash_rihs01(name) for name in names}


def _all(fields: Any, name: str) -> Any:
    own = fields[name]
    return own, [_all(fields, one) for one in re.findall(r"'(\w+/msg/\w+)'", str(own[1]))]


def test_humble_has_no_hashes() -> None:
    types = RosTypes("humble")
    assert types.message("std_msgs/msg/String").hash == "TypeHashNotSupported"
    assert types.service("std_srvs/srv/Trigger").hash == "TypeHashNotSupported"


# ------------------------------------------------------------------------------- smartcam_msgs


@pytest.mark.parametrize("distribution", WITH_HASHES)
def test_our_types_keep_their_hashes(distribution: str) -> None:
    types = RosTypes(distribution)
    assert set(SMARTCAM_MSGS) <= set(OURS)
    assert {name: hash_of(types, name) for name in OURS} == OURS


def test_files_of_the_package_are_what_we_send() -> None:
    files = [*PACKAGE.glob("msg/*"), *PACKAGE.glob("srv/*")]
    texts = {
        f"smartcam_msgs/{file.parent.name}/{file.stem}": file.read_text()
        for file in files
        if file.suffix == f".{file.parent.name}"
    }
    assert len(texts) == len(files)
    assert texts == SMARTCAM_MSGS


def test_the_package_builds_all_its_files_and_names_what_it_needs() -> None:
    listed = re.findall(
        r'"((?:msg|srv)/\w+\.(?:msg|srv))"', (PACKAGE / "CMakeLists.txt").read_text()
    )
    assert listed == sorted(
        f"{name.split('/', 1)[1]}.{name.split('/')[1]}" for name in SMARTCAM_MSGS
    )
    types = RosTypes()
    needs = set[str]()
    for name in SMARTCAM_MSGS:
        one = types.service(name) if "/srv/" in name else None
        for kind in (one.request, one.response) if one else (types.message(name),):
            needs |= {nested.partition("/")[0] for nested in kind.nested}
    root = ET.parse(PACKAGE / "package.xml").getroot()  # noqa: S314 - our own file
    assert root.get("format") == "3"
    assert root.findtext("name") == "smartcam_msgs"
    assert {one.text for one in root.findall("depend")} == needs - {"smartcam_msgs"}
    assert root.findtext("member_of_group") == "rosidl_interface_packages"


def test_bits_of_the_status_are_those_of_cameras() -> None:
    constants = RosTypes().message("smartcam_msgs/msg/CameraStatus").constants
    assert constants == {bit.name: int(bit) for bit in Status}


def test_fields_of_services_are_the_thesis() -> None:
    types = RosTypes()
    fields = {
        name: [
            [field.name for field in kind.fields]
            for one in [types.service(f"smartcam_msgs/srv/{name}")]
            for kind in (one.request, one.response)
        ]
        for name in ("SmartcameraSetup", "EnablePublishing", "SmartcameraStop", "ChangeApplication")
    }
    assert fields == {
        "SmartcameraSetup": [
            [
                *("camera_name", "camera_model_name", "port", "con_address"),
                *("application_id", "interpret_as", "topic_status"),
            ],
            ["error"],
        ],
        "EnablePublishing": [
            ["camera_name", "topic_for_outputs", "min_delay", "queue_size"],
            ["error"],
        ],
        "SmartcameraStop": [["camera_name"], ["error"]],
        "ChangeApplication": [["camera_name", "application_id"], ["error"]],
    }
    for name, outcome in (
        ("Trigger50ByteString", "strings"),
        ("TriggerLocalization", "localizations"),
    ):
        one = types.service(f"smartcam_msgs/srv/{name}")
        asked = [field.name for field in one.request.fields]
        assert asked == ["camera_name", "application_id", "timeout"]
        assert [field.name for field in one.response.fields] == ["error", outcome]
    localization = types.message("smartcam_msgs/msg/Localization").fields
    assert [(str(field), field.name) for field in localization] == [
        ("string", "feature_id"),
        ("float32", "quality"),
        ("int32", "photo_index"),
        ("geometry_msgs/PoseStamped", "pose"),
    ]


def test_fields_of_the_calibration_services_are_the_thesis() -> None:
    """Two answers of the thesis have no error, which has to be told all the same."""
    types = RosTypes()
    step = [
        *("error", "header_text", "description_text", "button_text"),
        *("descriptions_for_needed_values", "default_needed_values"),
        *("descriptions_for_needed_strings", "default_needed_strings"),
        *("descriptions_for_needed_options", "default_needed_options"),
    ]
    expected = {
        "StartCalibration": (
            [
                *("topic_image1", "topic_image2", "checkerboard_squaresize_m"),
                *("tf_frame_robot_tcp", "tf_frame_robot_base", "fixed_camera"),
            ],
            ["error"],
        ),
        "PerformCurrentAndGetNextStep": (
            ["repeat_last_step", "abort", "value_inputs", "text_inputs", "option_inputs"],
            step,
        ),
        "ExportCalibration": (["calibration_name", "target_path"], ["error"]),
        "LoadCalibration": (["calibration_name_or_path"], ["error"]),
        "TransformPixelPose": (
            ["header", "x", "y", "theta", "tf_frame_reference"],
            ["error", "pose"],
        ),
    }
    for name, both in expected.items():
        one = types.service(f"smartcam_msgs/srv/{name}")
        found = tuple([field.name for field in kind.fields] for kind in (one.request, one.response))
        assert found == both, name
