"""An RTSP client (RFC 2326) for cameras: requests, descriptions, and packets."""
