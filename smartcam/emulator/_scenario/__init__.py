"""An emulated camera as data, and what happens to it in the course of time."""
