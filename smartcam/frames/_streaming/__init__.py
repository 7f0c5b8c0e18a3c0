"""Send and receive streams: the shared stream, bit rate control, RTP and RTSP."""
