"""Depth: from two cameras to metres, clouds, and what is done to them.

Distances are metres, in the frame of the left camera after rectification: x right, y down, z ahead.
A depth of 0 is none. The extra ``depth`` brings OpenCV and small-gicp.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.depth._cloud import Cloud
    from smartcam.depth._cloud_files import load_cloud, save_cloud
    from smartcam.depth._filters import (
        crop_box,
        pass_through,
        remove_radius_outliers,
        remove_statistical_outliers,
        voxel_grid,
    )
    from smartcam.depth._matcher import Disparity, StereoMatcher
    from smartcam.depth._pair import read_camera_infos
    from smartcam.depth._registration import Registration, register
    from smartcam.depth._stereo import DepthFrame, StereoDepth, StereoStatistics

__all__ = [
    "Cloud",
    "DepthFrame",
    "Disparity",
    "Registration",
    "StereoDepth",
    "StereoMatcher",
    "StereoStatistics",
    "crop_box",
    "load_cloud",
    "pass_through",
    "read_camera_infos",
    "register",
    "remove_radius_outliers",
    "remove_statistical_outliers",
    "save_cloud",
    "voxel_grid",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_cloud": "Cloud",
            "_cloud_files": "load_cloud save_cloud",
            "_filters": "crop_box pass_through remove_radius_outliers remove_statistical_outliers "
            "voxel_grid",
            "_matcher": "Disparity StereoMatcher",
            "_pair": "read_camera_infos",
            "_registration": "Registration register",
            "_stereo": "DepthFrame StereoDepth StereoStatistics",
        },
    )
