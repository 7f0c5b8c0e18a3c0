"""Emulate a recorded camera: what it sends at which time."""
