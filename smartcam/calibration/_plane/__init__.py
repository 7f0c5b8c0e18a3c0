"""A camera's plane in the robot's space, from points that both know."""
