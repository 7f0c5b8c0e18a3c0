"""Keep calibrations in files: written whole or not at all, and never misread."""
