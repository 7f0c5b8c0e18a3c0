"""A program of ROS 1, on Debian's rospy: a line of JSON on stdin is done, and answered on stdout."""

import hashlib
import json
import sys
import threading
import time

import genpy
import roslib.message
import rosgraph
import rospy

lock = threading.Lock()


def said_of(value):
    if isinstance(value, genpy.Message):
        return {name: said_of(getattr(value, name)) for name in value.__slots__}
    if isinstance(value, genpy.rostime.TVal):
        return [value.secs, value.nsecs]
    if isinstance(value, bytes):
        return [len(value), hashlib.sha256(value).hexdigest()]
    if isinstance(value, (list, tuple)):
        return [said_of(one) for one in value]
    return value


def proxy(service, kind, **options):
    rospy.wait_for_service(service, 30)
    return rospy.ServiceProxy(service, roslib.message.get_service_class(kind), **options)


def call(service, kind, fields):
    return said_of(proxy(service, kind)(**fields))


def sure(service, kind, fields):
    """Call until it works: a service that is advertised again fails for a moment."""
    end = time.monotonic() + 30
    while True:
        try:
            return call(service, kind, fields)
        except rospy.ServiceException:
            if time.monotonic() > end:
                raise


def get(topic, kind):
    make = roslib.message.get_message_class(kind)
    return said_of(rospy.wait_for_message(topic, make, 30))


def state():
    publishers, _, services = rosgraph.Master("/peer").getSystemState()
    return {"topics": [one[0] for one in publishers], "services": [one[0] for one in services]}


def median(service, kind, fields, count):
    """Return how long a call takes, milliseconds."""
    do, spent = proxy(service, kind, persistent=True), []
    for _ in range(count):
        begun = time.perf_counter()
        do(**fields)
        spent.append(time.perf_counter() - begun)
    return sorted(spent)[count // 2] * 1e3


def own(service, kind):
    """Serve with what is empty."""
    make = roslib.message.get_service_class(kind)
    rospy.Service(service, make, lambda _: make._response_class())


DO = {"call": call, "sure": sure, "get": get, "state": state, "median": median, "own": own}


def answer(asked):
    try:
        said = {"ok": DO[asked["do"]](*asked["with"])}
    except Exception as error:
        said = {"error": f"{type(error).__name__}: {error}"}
    with lock:
        print(json.dumps({**said, "id": asked["id"]}), flush=True)


if __name__ == "__main__":
    rospy.init_node("peer", disable_signals=True)
    for line in sys.stdin:
        threading.Thread(target=answer, args=(json.loads(line),), daemon=True).start()
