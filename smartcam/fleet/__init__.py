"""Cameras of a plant, shared by many programs."""
