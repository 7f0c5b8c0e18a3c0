"""Calibrate a camera on a robot's hand, or one beside the robot that looks at it."""
