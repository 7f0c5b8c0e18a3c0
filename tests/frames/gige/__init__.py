"""Cameras that speak GigE Vision."""
