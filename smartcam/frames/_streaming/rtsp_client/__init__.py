"""An RTSP client (RFC 2326) of cameras: their answers, their descriptions, and their packets."""
