"""Names that other rooms import from this one; users do not need them."""

from __future__ import annotations

from smartcam.outlets._commands import do_command
from smartcam.outlets._outlets import columns_of, stored_accounts
from smartcam.outlets._settings import mistakes_of

__all__ = ["columns_of", "do_command", "mistakes_of", "stored_accounts"]
