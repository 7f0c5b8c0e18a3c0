"""A node of ROS 2 through the installed rclpy, over any middleware.

It knows nothing about cameras.
"""
