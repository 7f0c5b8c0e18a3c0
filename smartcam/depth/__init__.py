"""Depth: from two cameras to metres, clouds, and what is done to them.

Distances are metres, in the frame of the left camera after rectification: x right, y down, z ahead.
A depth of 0 is none. The extra ``depth`` brings OpenCV and small-gicp.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from smartcam._lazy import lazy

if TYPE_CHECKING:
    from smartcam.depth._cleaning import SpatialFilter, TemporalFilter, fill_holes
    from smartcam.depth._colours import ColourRange, ColourRegion, find_regions
    from smartcam.depth._matcher import Disparity, StereoMatcher
    from smartcam.depth._pair import read_camera_infos
    from smartcam.depth._regions import RegionDepth, equalize_depth, region_depth
    from smartcam.depth._stereo import DepthFrame, StereoDepth, StereoStatistics

__all__ = [
    "ColourRange",
    "ColourRegion",
    "DepthFrame",
    "Disparity",
    "RegionDepth",
    "SpatialFilter",
    "StereoDepth",
    "StereoMatcher",
    "StereoStatistics",
    "TemporalFilter",
    "equalize_depth",
    "fill_holes",
    "find_regions",
    "read_camera_infos",
    "region_depth",
]

if not TYPE_CHECKING:
    __getattr__ = lazy(
        __name__,
        {
            "_cleaning": "SpatialFilter TemporalFilter fill_holes",
            "_colours": "ColourRange ColourRegion find_regions",
            "_matcher": "Disparity StereoMatcher",
            "_pair": "read_camera_infos",
            "_regions": "RegionDepth equalize_depth region_depth",
            "_stereo": "DepthFrame StereoDepth StereoStatistics",
        },
    )
