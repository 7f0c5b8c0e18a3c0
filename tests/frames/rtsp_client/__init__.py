"""Tests of the RTSP client with emulated cameras and other projects' servers."""
