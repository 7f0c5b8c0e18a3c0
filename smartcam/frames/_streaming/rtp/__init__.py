"""Send H.264, and receive H.264, H.265 and JPEG, in packets of RTP (RFC 3550)."""
