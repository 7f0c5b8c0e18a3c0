"""Wizards: calibrations step by step, for any front-end."""
