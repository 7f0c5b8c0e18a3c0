"""Measure subpixel edges, lines, circles, lengths and angles in pictures."""
