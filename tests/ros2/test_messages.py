"""Results as messages of ROS: values, frames, stamps, and values that no message can hold."""

from __future__ import annotations

import json
import math
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smartcam import Localization, Result
from smartcam._client._inside import localizations_of
from smartcam.exceptions import RosMessageError
from smartcam.models import Header, Pose, Position, Quaternion
from smartcam.ros2 import RosTypes
from smartcam.ros2._inside import DETECTIONS, POSES, RESULT, ResultMessages, utf8

AT = datetime(2030, 1, 31, 12, 0, 0, 123_456, UTC)
TYPES = RosTypes()
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)


def part(name: str = "part", frame: str = "line1/cam3", x: float = 0.5) -> Localization:
    pose = Pose(Header(7, AT, frame), Position(x, -0.25, 0.125), Quaternion.from_theta(math.pi / 2))
    return Localization(name, 0.75, 3, pose)


def result(value: Any, *, application: int = 1, raw: bytes = b"\1\2") -> Result[Any]:
    return Result("line1/cam3", application, None, 7, None, AT, None, raw, value)


def messages(**options: Any) -> ResultMessages:
    return ResultMessages(TYPES, "line1/cam3", "line1_cam3", **options)


def read(kind: str, message: Any) -> Any:
    made = TYPES.message(kind)
    return made.decode(made.encode(message))


def test_poses_are_in_metres_with_quaternions() -> None:
    parts = [part(), part(x=-2.0)]
    got = read(POSES, messages().poses(result(parts), parts))
    assert [one.position.x for one in got.poses] == [0.5, -2.0]
    first = got.poses[0]
    assert (first.position.y, first.position.z) == (-0.25, 0.125)
    assert (first.orientation.x, first.orientation.y) == (0.0, 0.0)
    assert first.orientation.z == pytest.approx(math.sqrt(0.5))
    assert first.orientation.w == pytest.approx(math.sqrt(0.5))


def test_stamp_is_the_time_of_arrival_and_the_frame_the_cameras() -> None:
    got = read(POSES, messages().poses(result([part()]), [part()]))
    stamp = got.header.stamp
    assert (
        datetime(1970, 1, 1, tzinfo=UTC)
        + timedelta(seconds=stamp.sec, microseconds=stamp.nanosec // 1000)
        == AT
    )
    assert stamp.nanosec == 123_456_000
    assert got.header.frame_id == "line1_cam3"


def test_frame_of_a_calibration_stays() -> None:
    got = read(POSES, messages().poses(result([part(frame="robot")]), [part(frame="robot")]))
    assert got.header.frame_id == "robot"


class Robot:
    robot_frame = "base_link"

    def to_robot(self, parts: list[Localization]) -> list[Localization]:
        return parts


@pytest.mark.parametrize(
    ("calibration", "frame"),
    [
        (None, "line1_cam3"),
        (Robot(), "base_link"),
        ({1: Robot(), 2: None}, "base_link"),
        ({1: None, 2: Robot()}, "line1_cam3"),
    ],
)
def test_nothing_found_is_said_in_the_frame_where_it_would_be(calibration: Any, frame: str) -> None:
    got = read(POSES, messages(calibration=calibration).poses(result([]), []))
    assert (got.header.frame_id, got.poses) == (frame, [])


def test_poses_in_several_frames_are_no_pose_array() -> None:
    parts = [part(), part(frame="robot")]
    for make in (messages().poses, messages().detections):
        with pytest.raises(RosMessageError, match="one frame, got line1/cam3, robot"):
            make(result(parts), parts)
    got = read(RESULT, messages().result(result(parts), parts))
    frames = [one.pose.header.frame_id for one in got.localizations]
    assert (got.header.frame_id, frames) == ("", ["line1_cam3", "robot"])


def test_detections_have_feature_quality_and_pose() -> None:
    got = read(DETECTIONS, messages().detections(result([part("nut")]), [part("nut")]))
    (detection,) = got.detections
    (found,) = detection.results
    assert (found.hypothesis.class_id, found.hypothesis.score) == ("nut", 0.75)
    assert found.pose.pose == detection.bbox.center
    assert found.pose.pose.position.x == 0.5
    assert detection.header == got.header
    assert not found.pose.covariance.any()
    assert (detection.bbox.size.x, detection.id) == (0.0, "")


@given(NUMBERS, NUMBERS, st.floats(-math.pi, math.pi), st.floats(0, 1, width=32))
def test_localization_has_the_bits_of_the_camera(
    x: float, y: float, theta: float, quality: float
) -> None:
    pose = Pose(Header(1, AT, "line1/cam3"), Position(x, y, 0.0), Quaternion.from_theta(theta))
    one = Localization("p", quality, 2, pose)
    got = read(RESULT, messages().result(result([one]), [one])).localizations[0]
    position, turn = got.pose.pose.position, got.pose.pose.orientation
    assert (position.x, position.y, position.z) == (x, y, 0.0)
    assert (turn.x, turn.y, turn.z, turn.w) == pose.orientation
    assert (got.feature_id, got.quality, got.photo_index) == ("p", quality, 2)


def test_result_has_what_came() -> None:
    got = read(RESULT, messages().result(result([part()], application=9), [part()]))
    assert (got.camera_name, got.application_id, got.result_id) == ("line1/cam3", 9, 7)
    assert (bytes(got.data), got.error, got.json) == (b"\1\2", "", "")
    assert got.localizations[0].feature_id == "part"


def test_result_of_no_known_application_says_0() -> None:
    got = read(RESULT, messages().result(result(None, application=-1), None))
    assert (got.application_id, got.error) == (0, "")


@pytest.mark.parametrize("value", [["one", "zwölf"], {"x": 1.5, "ok": True}, [], "text", None, 3])
def test_other_values_are_said_as_json(value: Any) -> None:
    got = read(RESULT, messages().result(result(value), None))
    assert (json.loads(got.json), got.localizations, got.error) == (value, [], "")


def test_bytes_that_are_not_read_are_said_once() -> None:
    got = read(RESULT, messages().result(result(b"\1\2"), None))
    assert (got.json, bytes(got.data)) == ("", b"\1\2")


def test_value_that_is_no_json_is_an_error() -> None:
    class Odd:
        def _asdict(self) -> dict[str, Any]:
            raise KeyError("odd")

    got = read(RESULT, messages().result(result(Odd()), None))
    assert "KeyError('odd')" in got.error
    assert bytes(got.data) == b"\1\2"


def test_half_characters_and_nul_become_what_a_string_can_hold() -> None:
    assert utf8("a\0b\udcffc") == "a\ufffdb?c"
    got = read(RESULT, messages().result(result("a\0\ud800"), None))
    assert "\0" not in got.json


def test_error_is_never_empty_nor_endless() -> None:
    assert read(RESULT, messages().failed(ValueError(), AT)).error == "ValueError"
    assert len(read(RESULT, messages().failed(ValueError("x" * 9999), AT)).error) == 1000
    got = read(RESULT, messages().failed(ValueError("no part"), AT))
    assert (got.error, got.result_id, len(got.data)) == ("no part", 0, 0)
    assert got.header.frame_id == "line1_cam3"


@pytest.mark.parametrize("value", [None, "text", b"", [1], [part(), "text"], (part(),), {"a": 1}])
def test_what_is_no_list_of_localizations(value: Any) -> None:
    assert localizations_of(value) is None
