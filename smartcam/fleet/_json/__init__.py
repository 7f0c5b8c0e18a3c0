"""Serve programs that do not use smartcam: services and topics in JSON."""
