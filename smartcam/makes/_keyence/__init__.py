"""Cameras and readers of Keyence, whose protocols consist of lines that end with CR."""
