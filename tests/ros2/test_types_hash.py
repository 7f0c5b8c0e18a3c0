"""Type hashes against those that ROS' own generator wrote, and our package against what we send."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from rosbags.typesys import Stores, get_typestore

from smartcam.models import Status
from smartcam.ros2._definitions.smartcam import SMARTCAM_MSGS
from smartcam.ros2._types import RosTypes
from tests.ros2.typekit import add_test_msgs

GOLDEN: list[dict[str, Any]] = json.loads(
    (Path(__file__).parent / "golden" / "hashes.json").read_text()
)
PACKAGE = Path(__file__).parents[2] / "ros2" / "smartcam_msgs"
WITH_HASHES = ("jazzy", "kilted", "lyrical", "rolling")

OURS = {
    "msg/CameraStatus": "17202ed4949beb87d70c125acb875375a41f78944a91d5b4e548b875dd292098",
    "msg/Localization": "a1724c7208276df52ddebd9d9c14369f3f58eeaff4edaebd04ba2620ad42ec5c",
    "msg/Result": "e3a3655cd64406c8d1d39ad576b19b8cce62ec7e21dd76e4a7c4f3a593e03670",
    "srv/ChangeApplication": "6f0c0aa33debc90b7b5f8fa2ae51526be8e5b7a2d52d90d0cb02b09ccee175fc",
    "srv/EnablePublishing": "0982745dd9cdc8038dcf2cb7f0e6e49e0618678f3269fbc2bb8672c585db85aa",
    "srv/SmartcameraSetup": "125d329c562917497cef7303bea607174b47568827064560ca84a135086ffdd9",
    "srv/SmartcameraStop": "5f9171e099e77015979f55a18b34deb4948078c09cfae68e1fa94429bb4c12a5",
    "srv/Trigger50ByteString": "4b00cc4173a2f439176dfe7c987c9af93a713371446a6a32ee87258c47d8426f",
    "srv/TriggerLocalization": "3f86023467dd41c6abf306279c1b5d45f75657e222d4dffffbc3fbfb99180bb8",
}
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


@pytest.mark.parametrize("golden", GOLDEN, ids=lambda golden: golden["source"][:60])
def test_hashes_are_those_of_ros(golden: dict[str, Any]) -> None:
    types = RosTypes(golden["distribution"])
    add_test_msgs(types)
    assert golden["source"]
    got = {name: hash_of(types, name) for name in golden["hashes"]}
    assert got == golden["hashes"]


def test_golden_hashes_have_what_we_use() -> None:
    known = {name for golden in GOLDEN for name in golden["hashes"]}
    services = {name for name in RosTypes("lyrical").names() if "/srv/" in name}
    unknown = {one for one in services - known if not one.startswith("smartcam_msgs/")}
    assert unknown == {"polled_camera/srv/GetPolledImage"}  # was never brought to ROS 2
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
    assert {f"smartcam_msgs/{name}" for name in OURS} == set(SMARTCAM_MSGS)
    for name, digits in OURS.items():
        assert hash_of(types, f"smartcam_msgs/{name}") == f"RIHS01_{digits}"


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
        "SmartcameraStop": [["camera_name"], []],
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
        ("geometry_msgs/msg/PoseStamped", "pose"),
    ]
