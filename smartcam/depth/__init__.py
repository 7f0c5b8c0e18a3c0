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
    from smartcam.depth._registration import Registration, register

__all__ = [
    "Cloud",
    "Registration",
    "crop_box",
    "load_cloud",
    "pass_through",
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
            "_registration": "Registration register",
        },
    )
