"""Record an agent's cameras into a folder of files, and replay that folder as a fleet."""
