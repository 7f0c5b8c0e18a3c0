"""Depth: from two cameras to metres, clouds, and what is done to them.

Distances are metres, in the frame of the left camera after rectification: x right, y down, z ahead.
A depth of 0 means that there is no depth. The extra ``depth`` brings OpenCV and small-gicp.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.depth._cleaning import SpatialFilter, TemporalFilter, fill_holes
    from smartcam.depth._cloud import Cloud
    from smartcam.depth._cloud_files import load_cloud, save_cloud
    from smartcam.depth._colours import ColourRange, find_regions
    from smartcam.depth._filters import (
        crop_box,
        pass_through,
        remove_radius_outliers,
        remove_statistical_outliers,
        voxel_grid,
    )
    from smartcam.depth._matcher import StereoMatcher
    from smartcam.depth._pair import read_camera_infos
    from smartcam.depth._regions import equalize_depth, region_depth
    from smartcam.depth._registration import register
    from smartcam.depth._stereo import DepthFrame, StereoDepth

__all__ = [
    "Cloud",
    "ColourRange",
    "DepthFrame",
    "SpatialFilter",
    "StereoDepth",
    "StereoMatcher",
    "TemporalFilter",
    "crop_box",
    "equalize_depth",
    "fill_holes",
    "find_regions",
    "load_cloud",
    "pass_through",
    "read_camera_infos",
    "region_depth",
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
            "_cleaning": "SpatialFilter TemporalFilter fill_holes",
            "_cloud": "Cloud",
            "_cloud_files": "load_cloud save_cloud",
            "_colours": "ColourRange find_regions",
            "_filters": "crop_box pass_through remove_radius_outliers "
            "remove_statistical_outliers voxel_grid",
            "_matcher": "StereoMatcher",
            "_pair": "read_camera_infos",
            "_regions": "equalize_depth region_depth",
            "_registration": "register",
            "_stereo": "DepthFrame StereoDepth",
        },
    )
