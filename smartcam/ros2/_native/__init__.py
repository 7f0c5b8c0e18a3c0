"""A node of ROS 2 through the rclpy that is installed, over whatever middleware it has.

No camera is known here.
"""
