"""The package ``smartcam_msgs``; ``ros2/smartcam_msgs`` has each as a file."""

from __future__ import annotations

from typing import Final

SMARTCAM_MSGS: Final = {
    "smartcam_msgs/msg/Localization": """\
# One object that a camera found.

string feature_id                  # what was found, as the camera names it
float32 quality                    # 0 to 1
int32 photo_index                  # which photo of the result it was found in
geometry_msgs/PoseStamped pose     # in metres, in the frame that its header names
""",
}
