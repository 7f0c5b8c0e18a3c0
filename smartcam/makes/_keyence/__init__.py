"""Keyence: lines that end with CR."""
