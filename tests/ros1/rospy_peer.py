"""A program of ROS 1, on Debian's rospy: does a line of JSON from stdin, answers on stdout."""

import hashlib
import json
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
    return said_of(proxy(service, kind)(**fields))


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


DO: dict[str, Any] = {
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
