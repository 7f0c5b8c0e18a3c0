"""An RTSP server (RFC 2326) with Digest authentication (RFC 2617)."""
