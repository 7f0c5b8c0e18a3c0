"""Pictures through rospy (Debian's python3-rospy), stamp to stamp.

``python3 -m benchmarks.peers.rospy_pictures raw|jpeg SECONDS`` starts a roscore, a publisher and a
subscriber, and prints the latencies in milliseconds in one line and the sizes in the next one. The
system's Python runs it, which has rospy and need not have anything of ours.
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time

__all__ = ["PYTHON", "ROS", "can"]

SIZE = (640, 480)
RATE = 30

PYTHON = "/usr/bin/python3"
"""The system's."""

LIMIT = 20.0
"""Seconds until a subscriber that hears nothing is an error."""

ROS = "rospy, sensor_msgs.msg"


def can(modules: str) -> bool:
    """Return whether the system's Python has these modules, and there is a roscore."""
    try:
        found = subprocess.run(
            [PYTHON, "-c", f"import {modules}"], capture_output=True, check=False
        )
    except OSError:
        return False
    return found.returncode == 0 and shutil.which("roscore") is not None


def publish(how: str) -> None:
    """Publish pictures with their stamps until killed."""
    import rospy  # type: ignore[import-not-found]
    from sensor_msgs.msg import CompressedImage, Image

    rospy.init_node("near", disable_signals=True)
    kind = Image if how == "raw" else CompressedImage
    publisher = rospy.Publisher("pictures", kind, queue_size=1)
    row = bytes(range(256)) * 3
    picture = row[: SIZE[0]] * SIZE[1]
    coded = picture
    rate = rospy.Rate(RATE)
    number = 0
    while not rospy.is_shutdown():
        number += 1
        message = kind()
        message.header.seq = number
        began = time.monotonic_ns()
        message.header.frame_id = str(began)
        if how == "raw":
            message.height, message.width, message.step = SIZE[1], SIZE[0], SIZE[0]
            message.encoding, message.data = "mono8", picture
        else:
            coded = _jpeg(picture)
            message.format, message.data = "jpeg", coded
        publisher.publish(message)
        rate.sleep()


def subscribe(how: str, seconds: float) -> None:
    """Print what came."""
    import rospy
    from sensor_msgs.msg import CompressedImage, Image

    latencies: list[float] = []
    sizes: list[int] = []

    def heard(message: object) -> None:
        if how == "jpeg":
            _pixels(message.data)  # type: ignore[attr-defined]
        latencies.append((time.monotonic_ns() - int(message.header.frame_id)) / 1e6)  # type: ignore[attr-defined]
        sizes.append(len(message.data))  # type: ignore[attr-defined]

    rospy.init_node("far", disable_signals=True)
    rospy.Subscriber("pictures", Image if how == "raw" else CompressedImage, heard, queue_size=1)
    end = time.monotonic() + seconds + 3.0
    while not sizes or time.monotonic() < end:  # `main` ends it if none ever comes
        time.sleep(0.1)
    print(*latencies)
    print(*sizes)


def _jpeg(picture: bytes) -> bytes:
    import cv2
    import numpy as np

    pixels = np.frombuffer(picture, np.uint8).reshape(SIZE[1], SIZE[0])
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 15])[1].tobytes()


def _pixels(data: bytes) -> object:
    import cv2
    import numpy as np

    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)


def main(how: str, seconds: float) -> None:
    """Start the three, and pass on what the subscriber says."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    with tempfile.TemporaryDirectory() as home:
        names = {
            "ROS_MASTER_URI": f"http://127.0.0.1:{port}",
            "ROS_IP": "127.0.0.1",
            "ROS_HOME": home,
        }
        environment = {**os.environ, **names}
        here = [sys.executable, "-m", "benchmarks.peers.rospy_pictures"]
        started = [
            subprocess.Popen(
                [shutil.which("roscore") or "", "-p", str(port)],
                env=environment,
                stdout=subprocess.DEVNULL,
            )
        ]
        try:
            for _ in range(100):
                with socket.socket() as tried:
                    if tried.connect_ex(("127.0.0.1", port)) == 0:
                        break
                time.sleep(0.1)
            started.append(subprocess.Popen([*here, "publish", how], env=environment))
            subscriber = [*here, "subscribe", how, str(seconds)]
            subprocess.run(subscriber, env=environment, check=True, timeout=seconds + LIMIT)
        finally:
            for process in reversed(started):
                process.terminate()
                process.wait()


if __name__ == "__main__":
    words = sys.argv[1:]
    if words[0] == "publish":
        publish(words[1])
    elif words[0] == "subscribe":
        subscribe(words[1], float(words[2]))
    else:
        main(words[0], float(words[1]))
