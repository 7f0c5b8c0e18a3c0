"""Sources that FFmpeg reads: video files, web cameras and network streams."""
