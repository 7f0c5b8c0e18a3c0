"""tf2 itself, from Debian's package: it looks one frame up in another; JSON in, JSON out.

It is run by Debian's Python, and imports nothing of smartcam.
"""

import json
import sys

import rospy  # type: ignore[import-not-found]
import tf2_py  # type: ignore[import-not-found]
from geometry_msgs.msg import TransformStamped


def main() -> None:
    asked = json.load(sys.stdin)
    core = tf2_py.BufferCore(rospy.Duration(10))
    for parent, child, place, turn in asked["transforms"]:
        one = TransformStamped()
        one.header.frame_id, one.child_frame_id = parent, child
        moved, turned = one.transform.translation, one.transform.rotation
        moved.x, moved.y, moved.z = place
        turned.x, turned.y, turned.z, turned.w = turn
        core.set_transform_static(one, "test")
    try:
        found = core.lookup_transform_core(asked["target"], asked["source"], rospy.Time(0))
    except tf2_py.TransformException as exc:
        answer: dict[str, object] = {"error": str(exc)}
    else:
        moved, turned = found.transform.translation, found.transform.rotation
        answer = {
            "place": [moved.x, moved.y, moved.z],
            "turn": [turned.x, turned.y, turned.z, turned.w],
        }
    json.dump(answer, sys.stdout)


main()
