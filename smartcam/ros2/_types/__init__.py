"""ROS messages without ROS: their definitions, bytes (CDR) and hashes; without cameras."""
