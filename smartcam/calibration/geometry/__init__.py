"""Rotations, frames and homographies."""
