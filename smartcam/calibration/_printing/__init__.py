"""Lay out sheets with targets, to print them."""
