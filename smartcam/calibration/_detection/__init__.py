"""Find printed targets in images, refine their points and number them."""
