"""Write rosbag2 folders, from a running fleet or from a recording."""
