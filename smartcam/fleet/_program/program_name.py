"""A program's name, and the secret by which an agent knows that it is that program.

The name begins with the role of the program's certificate, which the engine's rules see to, and
ends with a digest of the secret. Everybody may see the name; the secret goes to agents alone. So
nobody can call, cancel or be present as another program, of whichever role that one is.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import socket
import sys
from pathlib import Path
from typing import NamedTuple

from smartcam.fleet._bus.keys import ANYONE
from smartcam.fleet._security.certificates import ROLES

ROLES_OF_NAMES = (*ROLES, ANYONE)
"""The roles that a name may begin with."""

SECRET_BYTES = 8
"""Bytes of a secret, and of its digest in the name."""


class ProgramName(NamedTuple):
    """The name of a program, and the secret that proves it.

    Attributes:
        name: what everybody may see, such as ``operator-robot1@host7-31-0f...``.
        secret: what only the program and its agents know.
    """

    name: str
    secret: str

    @property
    def token(self) -> str:
        """Both, as the program says them to agents."""
        return f"{self.name}.{self.secret}"

    @property
    def role(self) -> str:
        """The role that the name begins with."""
        return role_of(self.name)

    @property
    def genuine(self) -> bool:
        """True if the name belongs to whoever knows the secret, and begins with a role."""
        return self.role in ROLES_OF_NAMES and self.name.rpartition("-")[2] == _digest(self.secret)

    @classmethod
    def of(cls, token: str) -> ProgramName:
        """Return the name and secret that a program gives; they may not be genuine."""
        name, _, secret = token.partition(".")
        return cls(name, secret)

    @classmethod
    def new(cls, role: str, called: str | None = None) -> ProgramName:
        """Return a name for this process that no other program has.

        ``called``: what people call the program; default: its script.
        """
        secret = secrets.token_hex(SECRET_BYTES)
        role = role if role in ROLES else ANYONE
        return cls(f"{role}-{_process(called)}-{_digest(secret)}", secret)


def role_of(name: str) -> str:
    """Return the role that a program's name begins with."""
    return name.partition("-")[0]


def names_of(role: str) -> str:
    """Return the pattern of the names of all programs of a role."""
    return f"{role}-$*"


_PARTS = re.compile(r"[^-]+-(?P<called>.+)@(?P<host>.+)-(?P<pid>\d+)-[0-9a-f]+")


def in_words(name: str) -> str:
    """Return a program's name for people, such as ``robot1 on host7, pid 31``.

    One that no program of smartcam has is returned as it is.
    """
    parts = _PARTS.fullmatch(name)
    return name if parts is None else "{called} on {host}, pid {pid}".format(**parts.groupdict())


def _digest(secret: str) -> str:
    return hashlib.blake2b(secret.encode(), digest_size=SECRET_BYTES).hexdigest()


def _process(called: str | None) -> str:
    """Return a name of this process: what it is called, its host and number."""
    path = Path(sys.argv[0] if sys.argv else "")
    script = path.parent.name if path.stem == "__main__" else path.stem
    if script in {"", "-c", "-m"}:
        script = "python"
    host = socket.gethostname().partition(".")[0]
    return f"{_plain(called or script)}@{_plain(host)}-{os.getpid()}"


def _plain(text: str) -> str:
    """Return a text in letters that a key of the bus may have."""
    return re.sub(r"[^a-z0-9-]", "_", text.lower())
