"""Calibrate two cameras that look at the same place."""
