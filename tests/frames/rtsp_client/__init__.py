"""The RTSP client against cameras made by hand, and other people's servers."""
