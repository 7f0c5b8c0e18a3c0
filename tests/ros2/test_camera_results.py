"""Results on a node's topics: each once, in order, with what a direct client gets."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator
from typing import Any

import pytest

import smartcam
from smartcam import Camera
from smartcam.exceptions import ConfigurationError, RosError
from smartcam.ros2 import Node, QoS
from smartcam.ros2._inside import DETECTIONS, DRIVER, POSES, RESULT
from tests.client.clientkit import FAST
from tests.fleet.fleetkit import Plant, until
from tests.insides import inside
from tests.processes import free_place
from tests.ros2.camerakit import (
    BOTH,
    BROKEN,
    PARTS,
    PIXELS,
    READ_AS,
    RUNNING,
    TEXTS,
    PaperNode,
    PartsCamera,
    paper_or_rclpy,
)
from tests.ros2.inside import CameraResults

pytestmark = pytest.mark.through_rclpy

TOPICS = ("results", "localizations", "detections")


@contextlib.asynccontextmanager
async def published(
    node: Any = None, box: PartsCamera | None = None, **options: Any
) -> AsyncIterator[tuple[PartsCamera, Camera[Any], PaperNode, CameraResults]]:
    """A camera whose results are published on paper."""
    options.setdefault("interpret_as", READ_AS)
    made = PartsCamera() if box is None else box
    async with (
        paper_or_rclpy() if node is None else contextlib.nullcontext(node) as paper,
        made,
        smartcam.connect(made.url, name="line1/cam3", **options) as camera,
    ):
        results = CameraResults(camera, paper, frame_id="line1_cam3")
        results.start()
        try:
            yield made, camera, paper, results
        finally:
            await results.close()


async def test_result_is_published_as_its_trigger_gets_it() -> None:
    async with published() as (_, camera, node, results):
        got = await camera.trigger()
        await until(lambda: results.taken == 1)
        (said,), (poses,), (found,) = (node.said(topic) for topic in TOPICS)
        assert [one.feature_id for one in said.localizations] == ["run1", "run1"]
        for place, one in enumerate(got.value):
            x, y, z = one.pose.position
            for pose in (
                poses.poses[place],
                found.detections[place].results[0].pose.pose,
                said.localizations[place].pose.pose,
            ):
                assert (pose.position.x, pose.position.y, pose.position.z) == (x, y, z)
                turn = pose.orientation
                assert (turn.x, turn.y, turn.z, turn.w) == one.pose.orientation
        assert found.detections[0].results[0].hypothesis.class_id == "run1"
        assert (bytes(said.data), said.result_id) == (got.raw, got.number)
        assert said.header == poses.header == found.header
        assert said.header.frame_id == "line1_cam3"


async def test_topics_are_a_drivers() -> None:
    async with published() as (_, _, node, results):
        assert {name: one.type.name for name, one in node.publishers.items()} == {
            "/line1/cam3/results": RESULT,
            "/line1/cam3/localizations": POSES,
            "/line1/cam3/detections": DETECTIONS,
        }
        assert {one.qos for one in node.publishers.values()} == {DRIVER}
        results.start()
        assert len(node.publishers) == 3
        await results.close()
        await results.close()
        assert all(one.closed for one in node.publishers.values())


@pytest.mark.parametrize("count", [100, pytest.param(1000, marks=pytest.mark.long)])
async def test_results_come_once_and_in_order_whoever_triggered(count: int) -> None:
    async with published(box=PartsCamera(active=RUNNING)) as (_, camera, node, results):
        direct = camera.results(max_queue=100_000)
        found = [await anext(direct) for _ in range(count)]
        said = node.said("results")
        await until(lambda: said and said[-1].result_id >= found[-1].number)
        await results.close()
        for topic in TOPICS:
            assert len(node.said(topic)) == results.taken
        said = [one for one in said if one.result_id >= found[0].number][:count]
        names = [one.localizations[0].feature_id for one in said]
        assert names == [one.value[0].feature_id for one in found]
        assert [one.result_id for one in said] == sorted({one.result_id for one in said})
        stamps = [(one.header.stamp.sec, one.header.stamp.nanosec) for one in said]
        assert stamps == sorted(stamps)
        assert results.dropped == results.refused == 0


@pytest.mark.through_rclpy(False)  # it takes a time that only a clock of its own has
async def test_reconnects_lose_nothing_that_came_and_repeat_nothing() -> None:
    box = PartsCamera(active=RUNNING, rate=2.0)
    async with published(box=box, reconnect=FAST) as (_, camera, node, results):
        direct = camera.results()
        for turn in range(1, 4):
            await asyncio.sleep(11.0)  # else it was taken away
            inside(camera)._connection.require_link().abort(ConnectionResetError("pulled"))
            await until(lambda turn=turn: camera.statistics().sessions > turn)
        await asyncio.sleep(5)
        await camera.stop()
        await until(lambda: results.taken == camera.statistics().received)
        wanted = [(await anext(direct)).number for _ in range(results.taken)]
        assert [one.result_id for one in node.said("results")] == wanted
        assert len(wanted) == len(node.said("localizations")) > 60
        runs = [one.localizations[0].feature_id for one in node.said("results")]
        assert len({*runs}) == len(runs)


async def test_values_of_other_kinds_are_results_without_poses() -> None:
    async with published(box=PartsCamera(active=TEXTS)) as (_, camera, node, results):
        await camera.trigger()
        await until(lambda: results.taken == 1)
        (said,) = node.said("results")
        assert (said.json, said.localizations) == ('["one","two"]', [])
        assert node.said("localizations") == node.said("detections") == []


async def test_nothing_found_is_published_too() -> None:
    async with published(box=PartsCamera(active=BOTH)) as (_, camera, node, results):
        await camera.trigger()
        await until(lambda: results.taken == 1)
        assert node.said("localizations")[0].poses == []
        assert node.said("localizations")[0].header.frame_id == "line1_cam3"
        assert node.said("results")[0].localizations == []


async def test_empty_list_of_texts_is_no_absence_of_parts() -> None:
    options = {"interpret_as": "strings50"}
    async with published(box=PartsCamera(active=BOTH), **options) as (_, camera, node, results):
        await camera.trigger()
        await until(lambda: results.taken == 1)
        assert node.said("localizations") == []
        assert node.said("results")[0].json == "[]"


async def test_pixels_are_never_metres() -> None:
    async with published(box=PartsCamera(active=PIXELS)) as (_, camera, node, results):
        got = await camera.trigger()
        assert got.value[0].pose.position.x == 320.0
        await until(lambda: results.taken == 1)
        (said,) = node.said("results")
        assert (said.localizations, '"x":320.0' in said.json) == ([], True)
        assert node.said("localizations") == node.said("detections") == []


async def test_what_cannot_be_read_is_an_error_and_no_poses(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with published(box=PartsCamera(active=BROKEN)) as (_, camera, node, results):
        for _ in range(2):
            with pytest.raises(smartcam.InterpretationError):
                await camera.trigger()
        await until(lambda: results.taken == 2)
        first, second = node.said("results")
        assert "expected 50 bytes, got 9" in first.error
        assert (second.error, second.localizations, second.json) == (first.error, [], "")
        assert node.said("localizations") == node.said("detections") == []
        assert results.failed == 2
        await camera.trigger(PARTS)
        await until(lambda: results.taken == 3)
        assert len(node.said("localizations")) == 1
    told = [one for one in caplog.records if "could not be interpreted" in one.getMessage()]
    assert [one.levelno for one in told if one.levelno >= logging.WARNING] == [logging.WARNING]


async def test_what_a_calibration_refuses_is_no_camera_pose() -> None:
    class Refuses:
        def to_robot(self, parts: Any) -> Any:
            raise smartcam.CalibrationError("outside")

    options: dict[str, Any] = {"interpret_as": "localizations", "calibration": Refuses()}
    async with published(**options) as (_, camera, node, results):
        with pytest.raises(smartcam.InterpretationError):
            await camera.trigger()
        await until(lambda: results.taken == 1)
        assert "outside" in node.said("results")[0].error
        assert node.said("localizations") == []


async def test_calibrated_results_are_in_the_robots_frame() -> None:
    class Robot:
        robot_frame = "base_link"

        def to_robot(self, parts: Any) -> Any:
            header = parts[0].pose.header._replace(frame_id="base_link")
            return [one._replace(pose=one.pose._replace(header=header)) for one in parts]

    options: dict[str, Any] = {"interpret_as": READ_AS[PIXELS], "calibration": Robot()}
    async with published(box=PartsCamera(active=PIXELS), **options) as (_, camera, node, results):
        await camera.trigger()
        await until(lambda: results.taken == 1)
        (poses,) = node.said("localizations")
        assert (poses.header.frame_id, poses.poses[0].position.x) == ("base_link", 320.0)


async def test_nothing_is_made_that_nobody_hears() -> None:
    async with published() as (_, camera, node, results):
        for one in node.publishers.values():
            one.has_subscribers = False
        node.publishers["/line1/cam3/detections"].has_subscribers = True
        await camera.trigger()
        await until(lambda: results.taken == 1)
        assert [len(node.said(topic)) for topic in TOPICS] == [0, 0, 1]


async def test_inactive_node_publishes_nothing() -> None:
    async with published() as (_, camera, node, results):
        results.active = False
        await camera.trigger()
        await camera.trigger()
        results.active = True
        await camera.trigger()
        await until(lambda: results.taken == 1)
        assert [one.result_id for one in node.said("results")] == [3]


async def test_node_without_detections_has_the_rest() -> None:
    node = PaperNode()
    node.missing = {DETECTIONS}
    async with published(node) as (_, camera, _, results):
        await camera.trigger()
        await until(lambda: results.taken == 1)
        assert len(node.said("results")) == len(node.said("localizations")) == 1
        assert "/line1/cam3/detections" not in node.publishers


async def test_start_that_fails_leaves_nothing() -> None:
    node = PaperNode()
    node.missing = {POSES}
    async with PartsCamera() as box, smartcam.connect(box.url) as camera:
        results = CameraResults(camera, node)
        with pytest.raises(ConfigurationError):
            results.start()
        assert all(one.closed for one in node.publishers.values())
        assert camera.statistics().subscribers == []


async def test_publisher_that_fails_is_told_and_the_next_result_comes(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with published() as (_, camera, node, results):
        broken = node.publishers["/line1/cam3/localizations"]
        for error in (RosError("closed"), ValueError("a bug")):

            def publish(message: Any, error: Exception = error) -> None:
                raise error

            broken.publish = publish  # type: ignore[method-assign]
            await camera.trigger()
        await until(lambda: results.taken == 2)
        assert results.refused == 2
        assert len(node.said("detections")) == 2
    assert "a result was not published" in caplog.text


async def test_results_that_wait_have_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("smartcam.ros2._cameras.results.MAX_WAITING_RESULTS", 8)
    async with published() as (_, camera, node, results):
        got = await camera.trigger()
        await until(lambda: results.taken == 1)
        (stream,) = inside(camera)._listeners.results
        for number in range(20):  # in one turn of the loop
            stream.offer(got._replace(number=number), asyncio.get_running_loop().time())
        await until(lambda: results.taken == 9)
        said = [one.result_id for one in node.said("results")]
        assert (said, results.dropped) == ([1, *range(12, 20)], 12)


# ---------------------------------------------------------------------- a topic of one's choice


async def test_topic_of_choice_has_a_delay_and_a_queue() -> None:
    async with published() as (_, camera, node, results):
        loop = asyncio.get_running_loop()
        results.publish_on("outputs", 0.5, 2)
        began = loop.time()
        for _ in range(5):
            await camera.trigger()
        await until(lambda: results.taken == 5)
        said = node.publishers["/line1/outputs"]
        assert (said.type.name, said.qos) == (RESULT, QoS(depth=2))
        assert [one.result_id for one in said.messages] == [1]
        await until(lambda: len(said.messages) == 3)
        assert loop.time() - began >= 1.0
        assert [one.result_id for one in said.messages] == [1, 4, 5]
        assert results.dropped == 2
        assert len(node.said("results")) == 5


async def test_topic_of_choice_moves_and_ends() -> None:
    async with published() as (_, camera, node, results):
        results.publish_on("first")
        results.publish_on("second")
        assert node.publishers["/line1/first"].closed
        results.publish_on("second", 0.5, 7)
        assert not node.publishers["/line1/second"].closed
        with pytest.raises(ConfigurationError, match="expected"):
            results.publish_on("no topic")
        await camera.trigger()
        await until(lambda: results.taken == 1)
        assert len(node.publishers["/line1/second"].messages) == 1
        results.publish_on("")
        assert node.publishers["/line1/second"].closed


@pytest.mark.parametrize(
    "wrong",
    [
        {"min_delay": -1.0},
        {"min_delay": float("nan")},
        {"min_delay": 1e9},
        {"queue_size": 0},
        {"queue_size": 1 << 31},
        {"topic": "/line1/cam3/results"},
    ],
)
async def test_topic_of_choice_that_cannot_be(wrong: dict[str, Any]) -> None:
    async with published() as (_, _, _, results):
        with pytest.raises(ConfigurationError, match="expected"):
            results.publish_on(**{"topic": "outputs", **wrong})


@pytest.mark.through_rclpy(False)  # it takes a time that only a clock of its own has
async def test_closing_leaves_no_timer() -> None:
    async with published() as (_, camera, node, results):
        results.publish_on("outputs", 5.0)
        for _ in range(3):
            await camera.trigger()
        await until(lambda: results.taken == 3)
        await results.close()
        await asyncio.sleep(60.0)
        assert len(node.publishers["/line1/outputs"].messages) == 1


# ---------------------------------------------------------------------- a fleet's, and over TCP


async def test_results_of_other_programs_are_published_once() -> None:
    node = PaperNode("cam1")
    async with Plant() as plant, plant.cameras(2) as (own, other):
        results = CameraResults(own, node)
        results.start()
        for turn in range(20):
            await (own if turn % 2 else other).trigger()
        await until(lambda: results.taken == 20)
        await results.close()
        raws = [bytes(one.data)[0] for one in node.said("results")]
        assert raws == list(range(1, 21))


@pytest.mark.real_time
@pytest.mark.parametrize("count", [20, pytest.param(1000, marks=pytest.mark.long)])
async def test_another_node_hears_each_result_once_over_tcp(count: int) -> None:
    place = free_place()
    async with (
        asyncio.timeout(60),
        Node("cam3", namespace="/line1", listen=place) as node,
        Node("viewer", connect=place) as viewer,
        published(node) as (_, camera, _, results),
    ):
        kinds = dict(zip(TOPICS, (RESULT, POSES, DETECTIONS), strict=True))
        heard = {
            topic: viewer.subscribe(f"/line1/cam3/{topic}", kind) for topic, kind in kinds.items()
        }
        await until(lambda: all(one.has_subscribers for one in results._publishers.values()))
        for number in range(1, count + 1):
            got = await camera.trigger()
            said, poses, found = [await anext(one) for one in heard.values()]
            assert (said.result_id, bytes(said.data)) == (number, got.raw)
            xs = [one.pose.position.x for one in got.value]
            assert [one.position.x for one in poses.poses] == xs
            assert [one.bbox.center.position.x for one in found.detections] == xs
        assert all(one.statistics().queued == 0 for one in heard.values())
        assert camera.statistics().received == results.taken == count


@pytest.mark.real_time
@pytest.mark.long
async def test_results_at_once_reach_another_node() -> None:
    place = free_place()
    async with (
        asyncio.timeout(60),
        Node("cam3", namespace="/line1", listen=place) as node,
        Node("viewer", connect=place) as viewer,
        published(node) as (_, camera, _, results),
    ):
        heard = viewer.subscribe("/line1/cam3/results", RESULT, qos=QoS(depth=1000))
        await until(lambda: results.has_subscribers)
        got = await camera.trigger()
        await until(lambda: results.taken == 1)
        await anext(heard)
        for number in range(1000):
            for stream in inside(camera)._listeners.results:
                stream.offer(got._replace(number=number), asyncio.get_running_loop().time())
        said = [(await anext(heard)).result_id for _ in range(1000)]
        assert said == [*range(1000)]
