"""The emulated BVS camera: the device without its sockets."""
