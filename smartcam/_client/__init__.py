"""How a client works: from a link's bytes to who waits for what they say. Nothing is public."""
