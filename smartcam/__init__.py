"""smartcam: talk to industrial smart cameras."""
