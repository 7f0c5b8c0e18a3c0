"""A node of ROS 2 over the wire format of rmw_zenoh: topics, services, parameters, life cycle.

It knows nothing about cameras.
"""
