"""Protocols of binary frames: magic number, length, message id."""
