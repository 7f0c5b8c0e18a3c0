"""Publish cameras as ROS 2 nodes: results, services, pictures and depth."""
