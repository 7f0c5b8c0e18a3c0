"""A program's name, and the secret by which an agent recognizes the program.

The program is a process that uses a fleet. The name begins with the role in the program's
certificate, and ends with a digest of the secret. The bus checks the role; an agent checks the
digest. The name is public; the secret is sent only to agents. So no program can make or cancel
calls, or announce its presence, as another program.
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
"""The possible roles at the start of a name."""

SECRET_BYTES = 8
"""Number of bytes of a secret, and of its digest in the name."""


class ProgramName(NamedTuple):
    """The name of a program, and the secret that proves it.

    Attributes:
        name: the public name, such as ``operator-robot1@host7-31-0f...``.
        secret: the secret, which only the program and its agents know.
    """

    name: str
    secret: str

    @property
    def token(self) -> str:
        """Name and secret as one text, which is sent to agents."""
        return f"{self.name}.{self.secret}"

    @property
    def role(self) -> str:
        """The role at the start of the name."""
        return role_of(self.name)

    @property
    def is_genuine(self) -> bool:
        """True if the name begins with a role, and ends with the digest of the secret."""
        return self.role in ROLES_OF_NAMES and self.name.rpartition("-")[2] == _digest(self.secret)

    @classmethod
    def from_token(cls, token: str) -> ProgramName:
        """Return the name and secret in a program's token, without a check of them."""
        name, _, secret = token.partition(".")
        return cls(name, secret)

    @classmethod
    def new(cls, role: str, display_name: str | None = None) -> ProgramName:
        """Return a name for this process that no other program has.

        ``display_name``: name of the program for people; None: the name of its script.
        """
        secret = secrets.token_hex(SECRET_BYTES)
        role = role if role in ROLES else ANYONE
        return cls(f"{role}-{_process_name(display_name)}-{_digest(secret)}", secret)


def role_of(name: str) -> str:
    """Return the role at the start of a program's name."""
    return name.partition("-")[0]


def names_pattern(role: str) -> str:
    """Return the pattern that the names of all programs of a role match."""
    return f"{role}-$*"


_PARTS = re.compile(r"[^-]+-(?P<display_name>.+)@(?P<host>.+)-(?P<pid>\d+)-[0-9a-f]+")


def in_words(name: str) -> str:
    """Return a program's name for people, such as ``robot1 on host7, pid 31``.

    A name that is not one of a program of smartcam is returned unchanged.
    """
    parts = _PARTS.fullmatch(name)
    return (
        name if parts is None else "{display_name} on {host}, pid {pid}".format(**parts.groupdict())
    )


def _digest(secret: str) -> str:
    return hashlib.blake2b(secret.encode(), digest_size=SECRET_BYTES).hexdigest()


def _process_name(display_name: str | None) -> str:
    """Return a name of this process: its name for people, its host and its process id."""
    path = Path(sys.argv[0] if sys.argv else "")
    script = path.parent.name if path.stem == "__main__" else path.stem
    if script in {"", "-c", "-m"}:
        script = "python"
    host = socket.gethostname().partition(".")[0]
    return f"{_key_text(display_name or script)}@{_key_text(host)}-{os.getpid()}"


def _key_text(text: str) -> str:
    """Return a text with only characters that a key of the bus may have."""
    return re.sub(r"[^a-z0-9-]", "_", text.lower())
