"""Emulate a recorded camera, with its messages and their times."""
