"""Bytes that rmw_zenoh puts on the wire, each with its source.

The examples are those of ``docs/design.md`` of rmw_zenoh (rolling, sections on keys, "Graph Cache"
and "Publishers"), recorded there from ``demo_nodes_cpp``.
"""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam._ros_names import as_name, check_namespace, check_node, resolve
from smartcam.exceptions import ConfigurationError, RosMessageError
from smartcam.ros2 import QoS
from smartcam.ros2._inside import DRIVER, LATCHED
from tests.ros2.inside import PARAMETERS, SENSOR_DATA, Attachment, Entity, gid_of

STRING = "std_msgs::msg::dds_::String_"
STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
ADD = "example_interfaces::srv::dds_::AddTwoInts_"
ADD_HASH = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"

LISTENER, TALKER, SERVER, CLIENT = (
    "aac3178e146ba6f1fc6e6a4085e77f21",
    "8b20917502ee955ac4476e0266340d5c",
    "f9980ee0495eaafb3e38f0d19e2eae12",
    "e1dc8d1b45ae8717fce78689cc655685",
)

TOKENS = {
    f"@ros2_lv/2/{LISTENER}/0/0/NN/%/%/listener": Entity("NN", 2, LISTENER, 0, 0, "/", "listener"),
    f"@ros2_lv/2/{LISTENER}/0/10/MS/%/%/listener/%chatter/{STRING}/{STRING_HASH}/::,10:,:,:,,": (
        Entity("MS", 2, LISTENER, 0, 10, "/", "listener", "/chatter", STRING, STRING_HASH)
    ),
    f"@ros2_lv/2/{TALKER}/0/10/MP/%/%/talker/%chatter/{STRING}/{STRING_HASH}/::,7:,:,:,,": (
        Entity("MP", 2, TALKER, 0, 10, "/", "talker", "/chatter", STRING, STRING_HASH, QoS(depth=7))
    ),
    f"@ros2_lv/2/{SERVER}/0/10/SS/%/%/add_two_ints_server/%add_two_ints/{ADD}/{ADD_HASH}"
    "/::,10:,:,:,,": Entity(
        "SS", 2, SERVER, 0, 10, "/", "add_two_ints_server", "/add_two_ints", ADD, ADD_HASH
    ),
    f"@ros2_lv/2/{CLIENT}/0/10/SC/%/%/add_two_ints_client/%add_two_ints/{ADD}/{ADD_HASH}"
    "/::,10:,:,:,,": Entity(
        "SC", 2, CLIENT, 0, 10, "/", "add_two_ints_client", "/add_two_ints", ADD, ADD_HASH
    ),
}


@pytest.mark.parametrize(("token", "entity"), TOKENS.items())
def test_tokens_are_those_of_the_design(token: str, entity: Entity) -> None:
    assert entity.token == token
    assert Entity.parse(token) == entity


def test_keys_are_those_of_the_design() -> None:
    talker = Entity("MP", 0, TALKER, 0, 10, "/", "talker", "/chatter", STRING, STRING_HASH)
    assert talker.key == f"0/chatter/{STRING}/{STRING_HASH}"
    robot = Entity("MP", 0, TALKER, 0, 1, "/robot1", "t", "/robot1/chatter", STRING, STRING_HASH)
    assert robot.key == f"0/robot1/chatter/{STRING}/{STRING_HASH}"
    assert "/%/%robot1/t/%robot1%chatter/" in robot.token
    add = Entity("SS", 2, SERVER, 0, 1, "/", "s", "/add_two_ints", ADD, ADD_HASH)
    assert add.key == f"2/add_two_ints/{ADD}/{ADD_HASH}"
    assert add.ros_type == "example_interfaces/srv/AddTwoInts"


def test_a_newer_token_may_name_backends_of_buffers() -> None:
    (token, entity), *_ = [one for one in TOKENS.items() if "/MP/" in one[0]]
    assert Entity.parse(f"{token}/cpu") == entity


def test_gid_is_xxh3_of_the_token_low_half_first() -> None:
    # liveliness_utils.cpp, Entity::Entity: low64 first, then high64. XXH3 of nothing with 128 bits
    # is 99aa06d3014798d86001c324468d497f in the xxHash project's own table of checks.
    assert gid_of("") == bytes.fromhex("7f498d4624c30160d8984701d306aa99")
    assert len({gid_of(token) for token in TOKENS}) == len(TOKENS)


@pytest.mark.parametrize(
    "token",
    [
        "",
        "@ros2_lv/0",
        f"@ros2_lv/0/{TALKER}/0/0/XX/%/%/talker",
        f"@ros2_lv/x/{TALKER}/0/0/NN/%/%/talker",
        f"@ros2_lv/0/{TALKER}/0/0/NN/%/%/talker/more",
        f"@ros2_lv/0/{TALKER}/0/10/MP/%/%/talker/%chatter/{STRING}/{STRING_HASH}",
        f"@ros2_lv/0/{TALKER}/0/10/MP/%/%/talker/%chatter/{STRING}/{STRING_HASH}/::,x:,:,:,,",
        f"@ros2_lv/0/{TALKER}/0/10/MP/%/%/talker/%chatter/{STRING}/{STRING_HASH}/::",
        f"elsewhere/0/{TALKER}/0/0/NN/%/%/talker",
    ],
)
def test_what_is_no_token_is_told(token: str) -> None:
    with pytest.raises(ValueError, match=r"expected|invalid literal"):
        Entity.parse(token)


# ---------------------------------------------------------------------- quality of service


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        # qos.cpp: reliable, volatile, keep last 42 are left out; qos_to_keyexpr has the order
        (QoS(depth=42), "::,:,:,:,,"),
        (QoS(), "::,10:,:,:,,"),
        (DRIVER, "::,5:,:,:,,"),
        (SENSOR_DATA, "2::,5:,:,:,,"),
        (LATCHED, ":1:,1:,:,:,,"),
        (PARAMETERS, "::,1000:,:,:,,"),
        (QoS(depth=None), "::2,:,:,:,,"),
        # rcl's profile of /rosout: latched, 1000, lifespan of 10 s
        (QoS(latched=True, depth=1000, lifespan=10), ":1:,1000:,:10,0:,,"),
    ],
)
def test_quality_of_service_there_and_back(qos: QoS, text: str) -> None:
    assert qos.encode() == text
    assert QoS.decode(text) == qos


def test_system_defaults_and_endless_durations_are_read_as_what_they_mean() -> None:
    assert QoS.decode("0:0:0,0:,:,:,,") == QoS(depth=42)
    endless = "9223372036,854775807"
    assert QoS.decode(f"1:2:1,42:{endless}:{endless}:1,{endless}") == QoS(depth=42)
    assert QoS.decode("::,10:0,0:0,0:1,0,0") == QoS()


@pytest.mark.parametrize(
    "wrong", [{"depth": 0}, {"depth": -1}, {"lifespan": 0}, {"lifespan": math.nan}]
)
def test_a_quality_of_service_that_cannot_be(wrong: dict[str, float]) -> None:
    with pytest.raises(ConfigurationError, match="QoS"):
        QoS(**wrong)  # type: ignore[arg-type]


# ---------------------------------------------------------------------- attachments


def test_attachment_is_33_bytes() -> None:
    # design.md, "Publishers": int64, int64, the length 16, the GID; little-endian
    gid = bytes(range(16))
    made = Attachment(1, 0x0102030405060708, gid)
    data = bytes.fromhex("0100000000000000080706050403020110") + gid
    assert made.encode() == data
    assert Attachment.decode(data) == made


@given(st.binary(max_size=64))
def test_any_bytes_are_an_attachment_or_told(data: bytes) -> None:
    try:
        made = Attachment.decode(data)
    except RosMessageError:
        return
    assert made.encode() == data


def test_no_attachment_is_told() -> None:
    with pytest.raises(RosMessageError, match="got nothing"):
        Attachment.decode(None)


# ---------------------------------------------------------------------- names


@pytest.mark.parametrize(
    ("name", "full"),
    [("/a/b", "/a/b"), ("a/b", "/line1/a/b"), ("~/a", "/line1/cam3/a"), ("~", "/line1/cam3")],
)
def test_names_are_resolved(name: str, full: str) -> None:
    assert resolve(name, "/line1", "cam3") == full


def test_names_at_the_root() -> None:
    assert resolve("a", "/", "cam3") == "/a"
    assert resolve("~/a", "/", "cam3") == "/cam3/a"
    assert check_namespace("line1/") == "/line1"
    assert check_namespace("") == check_namespace("/") == "/"


@pytest.mark.parametrize(
    "name", ["", "/", "a//b", "1a", "a/1b", "a b", "a-b", "a/", "é", "a__b", "~a", "x" * 300]
)
def test_names_that_cannot_be(name: str) -> None:
    with pytest.raises(ConfigurationError, match="ROS topic"):
        resolve(name, "/", "cam3")


@pytest.mark.parametrize("name", ["", "a/b", "1a", "a-b", "a__b"])
def test_nodes_that_cannot_be(name: str) -> None:
    with pytest.raises(ConfigurationError, match="ROS node"):
        check_node(name)


@given(st.lists(st.text("abz019_-", min_size=1, max_size=8), min_size=1, max_size=4))
def test_every_camera_has_a_name_in_ros(parts: list[str]) -> None:
    name = as_name("/".join(parts))
    namespace, _, node = f"/{name}".rpartition("/")
    assert check_namespace(namespace) == namespace or namespace == ""
    assert check_node(node) == node


def test_names_of_cameras() -> None:
    names = ["line1/cam3", "line-1/cam3", "3d/1", "a--b"]
    found = ["line1/cam3", "line_1/cam3", "_3d/_1", "a_b"]
    assert [as_name(name) for name in names] == found
    assert not any("__" in as_name(a + b) for a, b in itertools.product("a_-", repeat=2))
