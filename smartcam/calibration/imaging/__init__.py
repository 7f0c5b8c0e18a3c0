"""Calibration from images: printed targets, lenses, pairs of cameras, cameras on robots."""
