"""Read video files, web cameras and network streams by FFmpeg."""
