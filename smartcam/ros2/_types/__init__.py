"""ROS messages without ROS: definitions, their bytes (CDR) and their hashes. No camera is known."""
