"""A camera on a robot's hand, or beside the robot and looking at it."""
