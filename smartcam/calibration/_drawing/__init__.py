"""Draw calibrations that were made from images, as SVG."""
