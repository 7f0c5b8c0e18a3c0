"""Tests of the interpreter ``weights``; they need ``smartcam[suites]``."""

import struct

from smartcam_weights import weights

from smartcam.testing import ContainerSample, InterpreterSuite


def container(order: str) -> bytes:
    """Return a container of two parts, in a byte order of struct."""
    return struct.pack(order + "10sf10sf", b"bolt", 0.25, b"nut", 0.125)


class TestWeights(InterpreterSuite):
    """Inherits the tests."""

    spec = weights
    name = "weights"
    samples = (
        ContainerSample(container("<"), {"bolt": 0.25, "nut": 0.125}, big=container(">")),
        ContainerSample(b"", {}, big=b"", name="no part"),
    )
