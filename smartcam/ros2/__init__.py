"""Cameras in ROS 2, without a ROS installation: over the wire format of rmw_zenoh."""

from __future__ import annotations

__all__: list[str] = []
