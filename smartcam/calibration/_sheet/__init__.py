"""Calibrate a camera above a printed sheet: one picture maps its pixels to the robot."""
