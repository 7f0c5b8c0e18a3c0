"""Model the lens of a camera, and calibrate it from views."""
