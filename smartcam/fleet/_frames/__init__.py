"""Frames of shared cameras: at the agent, on the bus, and in a program."""
