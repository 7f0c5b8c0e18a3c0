"""Tests of cameras with GigE Vision."""
