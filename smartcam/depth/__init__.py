"""Depth: from two cameras to metres, clouds, and what is done to them.

Distances are metres, in the frame of the left camera after rectification: x right, y down, z ahead.
A depth of 0 is none. The extra ``depth`` brings OpenCV and small-gicp.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.depth._matcher import Disparity, StereoMatcher
    from smartcam.depth._pair import read_camera_infos
    from smartcam.depth._stereo import DepthFrame, StereoDepth, StereoStatistics

__all__ = [
    "DepthFrame",
    "Disparity",
    "StereoDepth",
    "StereoMatcher",
    "StereoStatistics",
    "read_camera_infos",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_matcher": "Disparity StereoMatcher",
            "_pair": "read_camera_infos",
            "_stereo": "DepthFrame StereoDepth StereoStatistics",
        },
    )
