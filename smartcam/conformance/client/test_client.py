"""The tests that ``pytest --pyargs smartcam.conformance.client --client-command ...`` runs."""

from __future__ import annotations

from smartcam.conformance.client._suite import ClientConformance


class TestClient(ClientConformance):
    """The client of ``--client-command``."""
