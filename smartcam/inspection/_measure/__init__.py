"""Measure in pictures: edges to a fraction of a pixel, lines, circles, lengths and angles."""
