"""Send and receive video streams: shared encoding, bit rate control, RTP and RTSP."""
