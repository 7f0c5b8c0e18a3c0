"""Cameras in ROS 1, over a rosbridge."""

from __future__ import annotations

__all__: list[str] = []
