"""Printed targets in images: found, refined, numbered."""
