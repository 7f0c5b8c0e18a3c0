"""Cameras of ifm, by their process interface PCIC."""
