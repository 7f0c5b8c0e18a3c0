"""Pictures of calibrations from images, as SVG."""
