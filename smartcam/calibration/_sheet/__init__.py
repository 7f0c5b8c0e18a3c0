"""A camera above a printed sheet, one picture of which brings its pixels to the robot."""
