"""Locate taught parts at any angle and scale, to a fraction of a pixel, with a covariance."""
