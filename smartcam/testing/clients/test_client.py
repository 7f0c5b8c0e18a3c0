"""What ``pytest --pyargs smartcam.testing.clients --client-command ...`` runs."""

from __future__ import annotations

from smartcam.testing.clients.suite import ClientConformance

__all__ = ["TestClient"]


class TestClient(ClientConformance):
    """The client of ``--client-command``."""
