"""A program of ROS 1, on Debian's rospy: does a line of JSON from stdin, answers on stdout."""

import hashlib
import json
import re
import sys
import threading
import time
from typing import Any

import genpy  # type: ignore[import-not-found]
import rosgraph  # type: ignore[import-not-found]
import roslib.message  # type: ignore[import-not-found]
import rospy  # type: ignore[import-not-found]

lock = threading.Lock()


def said_of(value: Any) -> Any:
    if isinstance(value, genpy.Message):
        return {name: said_of(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, genpy.rostime.TVal):
        return [value.secs, value.nsecs]
    if isinstance(value, bytes):
        return [len(value), hashlib.sha256(value).hexdigest()]
    if isinstance(value, (list, tuple)):
        return [said_of(one) for one in value]
    return value


def proxy(service: Any, kind: Any, **options: Any) -> Any:
    rospy.wait_for_service(service, 30)
    return rospy.ServiceProxy(service, roslib.message.get_service_class(kind), **options)


def call(service: Any, kind: Any, fields: Any) -> Any:
    """Call; again where rospy finds no such service, which is so while it is being advertised."""
    end = time.monotonic() + 30
    while True:
        try:
            return said_of(proxy(service, kind)(**fields))
        except rospy.ServiceException as error:
            if not str(error).endswith("unavailable") or time.monotonic() > end:
                raise


def sure(service: Any, kind: Any, fields: Any) -> Any:
    """Call until it works: a service that is advertised again fails for a moment."""
    end = time.monotonic() + 30
    while True:
        try:
            return call(service, kind, fields)
        except rospy.ServiceException:
            if time.monotonic() > end:
                raise


def get(topic: Any, kind: Any) -> Any:
    make = roslib.message.get_message_class(kind)
    return said_of(rospy.wait_for_message(topic, make, 30))


def state() -> Any:
    publishers, _, services = rosgraph.Master("/peer").getSystemState()
    return {"topics": [one[0] for one in publishers], "services": [one[0] for one in services]}


def median(service: Any, kind: Any, fields: Any, count: Any) -> Any:
    """Return how long a call takes, milliseconds."""
    do, spent = proxy(service, kind, persistent=True), []
    for _ in range(count):
        begun = time.perf_counter()
        do(**fields)
        spent.append(time.perf_counter() - begun)
    return sorted(spent)[count // 2] * 1e3


def own(service: Any, kind: Any) -> Any:
    """Serve with what is empty."""
    make = roslib.message.get_service_class(kind)
    rospy.Service(service, make, lambda _: make._response_class())


class Tip:
    """A robot on ``/tf``, whose tip somebody moves."""

    def __init__(self) -> None:
        make = roslib.message.get_message_class("tf2_msgs/TFMessage")
        publisher = rospy.Publisher("/tf", make, queue_size=10)
        stamped = roslib.message.get_message_class("geometry_msgs/TransformStamped")
        self.place, self.going = (0.0, 0.0, 0.0), True

        def say() -> None:
            while self.going:
                one = stamped()
                one.header.stamp = rospy.Time.now()
                one.header.frame_id, one.child_frame_id = "base", "tip"
                moved, turned = one.transform.translation, one.transform.rotation
                moved.x, moved.y, moved.z = self.place
                turned.x = 1.0  # the tool points down
                publisher.publish(make([one]))
                time.sleep(0.02)

        threading.Thread(target=say, daemon=True).start()


def calibrate(camera: Any, name: Any) -> Any:
    """Drive the thesis' services to the end of a plane, with a table one metre from the base."""
    kind = "smartcam_msgs/PerformCurrentAndGetNextStep"
    said = {"topic_image2": "SMARTCAMERA", "tf_frame_robot_tcp": "tip", "fixed_camera": "True"}
    tip, titles, more = Tip(), [], {}
    errors = [sure(f"{camera}/StartCalibration", "smartcam_msgs/StartCalibration", said)["error"]]
    step = sure(f"{camera}/PerformCurrentAndGetNextStep", kind, {})
    while step["button_text"]:
        titles.append(step["header_text"])
        given = {
            "value_inputs": step["default_needed_values"],
            "text_inputs": step["default_needed_strings"],
            "option_inputs": [one.split()[0] for one in step["default_needed_options"]],
        }
        if titles == ["Calibration"]:
            given["text_inputs"] = [name]
        if step["header_text"] == "What came out":
            given["option_inputs"] = ["accept"]
        seen = re.search(r"at x (-?[0-9.]+) mm, y (-?[0-9.]+) mm", step["description_text"])
        if seen and step["header_text"].startswith("Touch mark"):
            x, y = (float(one) / 1000 for one in seen.groups())
            tip.place = (x + 1.0, y, 0.5)
            time.sleep(0.3)
        step = call(f"{camera}/PerformCurrentAndGetNextStep", kind, given)
        errors.append(step["error"])
    tip.going = False
    asked = {"x": 0.05, "y": 0.02}
    more["pose"] = call(f"{camera}/TransformPixelPose", "smartcam_msgs/TransformPixelPose", asked)
    target = {"calibration_name": name, "target_path": "copy.json"}
    more["exported"] = call(
        f"{camera}/ExportCalibration", "smartcam_msgs/ExportCalibration", target
    )
    bad = {"calibration_name_or_path": "../fleet"}
    more["refused"] = call(f"{camera}/LoadCalibration", "smartcam_msgs/LoadCalibration", bad)
    return {"titles": titles, "errors": errors, "text": step["description_text"], **more}


DO: dict[str, Any] = {
    "calibrate": calibrate,
    "call": call,
    "sure": sure,
    "get": get,
    "state": state,
    "median": median,
    "own": own,
}


def answer(asked: Any) -> Any:
    try:
        said = {"ok": DO[asked["do"]](*asked["with"])}
    except Exception as error:  # noqa: BLE001 - it is the answer
        said = {"error": f"{type(error).__name__}: {error}"}
    with lock:
        sys.stdout.write(json.dumps({**said, "id": asked["id"]}) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    rospy.init_node("peer", disable_signals=True)
    for line in sys.stdin:
        threading.Thread(target=answer, args=(json.loads(line),), daemon=True).start()
