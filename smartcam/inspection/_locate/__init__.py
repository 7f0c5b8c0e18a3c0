"""Locate taught parts: any angle and scale, to a fraction of a pixel, with a true covariance."""
