"""The client's inside: from a link's bytes to the waiting tasks. Nothing is public."""
