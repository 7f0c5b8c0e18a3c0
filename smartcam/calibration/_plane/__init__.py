"""Calibrate a camera's plane in the robot's space, from points known to both."""
