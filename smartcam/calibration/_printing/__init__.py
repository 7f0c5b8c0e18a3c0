"""Sheets with targets, to print."""
