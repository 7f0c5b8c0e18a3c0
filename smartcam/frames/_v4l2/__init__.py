"""Video4Linux cameras on the standard library: ioctl, mmap, and the event loop's reader."""
