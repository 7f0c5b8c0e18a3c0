"""The client's inside: from a link's bytes to the tasks that wait for them. Nothing is public."""
