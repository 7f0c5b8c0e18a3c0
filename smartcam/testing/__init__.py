"""Tools for tests of a client or a camera; nothing but tests imports them.

::

    async with LinkProxy("127.0.0.1", emulator.port, rules=[Cut(at=20)]) as proxy:
        async with smartcam.connect(proxy.url(emulator.url)) as camera:
            ...
"""

from smartcam.testing.proxy import LinkProxy

__all__ = ["LinkProxy"]
