"""Define the settings of a server of OPC UA."""

from __future__ import annotations

from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field, model_validator

from smartcam.outlets._settings import OutletSettings, Secret

MAX_USERS = 100
"""Largest number of users of one server."""

MAX_RECIPES = 1000
"""Largest number of names for applications."""


def _check_endpoint(text: str) -> str:
    try:
        parts = urlsplit(text)
        fits = parts.scheme == "opc.tcp" and parts.hostname and parts.port
        fits = fits and not (parts.query or parts.username)
    except ValueError:
        fits = False
    if not fits:
        raise ValueError("expected opc.tcp://HOST:PORT, such as opc.tcp://0.0.0.0:4840")
    return text


class OpcUaSettings(OutletSettings):
    """The settings of a server of OPC UA."""

    timeout: float = Field(
        120.0, gt=0, le=3600, description="seconds of the timeout for the server's start"
    )
    listen: Annotated[str, AfterValidator(_check_endpoint)] = Field(
        description="opc.tcp://HOST:PORT; 0.0.0.0 for all of this computer's addresses"
    )
    users: dict[str, Secret] = Field(
        {},
        max_length=MAX_USERS,
        description="users and the sources of their passwords: {plc: {file: PATH}}",
    )
    user_certificates: dict[str, Annotated[str, Field(min_length=1)]] = Field(
        {},
        max_length=MAX_USERS,
        description="users and the files of their certificates: {plc: plc.der}",
    )
    anonymous: Literal["no", "read", "control"] = Field(
        "no",
        description="rights without login: read, to see values and events; or control, to call "
        "methods, too",
    )
    unencrypted: bool = Field(
        False, description="also accept unencrypted sessions, in which passwords are readable"
    )
    certificate: str | None = Field(
        None,
        min_length=1,
        description="file of the server's certificate; default: one made beside the spool",
    )
    key: str | None = Field(
        None, min_length=1, description="file of the certificate's private key, in PEM"
    )
    clients: str | None = Field(
        None,
        min_length=1,
        description="folder with a certificate of each client that uses encryption",
    )
    recipes: dict[str, Annotated[int, Field(ge=0, le=0xFFFFFFFF)]] = Field(
        {}, max_length=MAX_RECIPES, description="names for applications: {housing: 7}"
    )
    automatic: bool = Field(
        True,
        description="become ready without a client when the camera is connected, and after each "
        "reconnect",
    )
    trigger_timeout: float = Field(5.0, gt=0, le=300, description="seconds of a job's timeout")
    switch_timeout: float = Field(
        10.0, gt=0, le=300, description="seconds of the timeout for preparing an application"
    )
    kept_results: int = Field(
        1000, ge=1, le=100_000, description="number of kept results of all cameras, for clients"
    )
    pictures: str | None = Field(
        None,
        min_length=1,
        description="path of a result's picture, beside this file, with {camera}, {application}, "
        "{number} and {sequence} in it; clients get it by ResultTransfer",
    )

    @model_validator(mode="after")
    def _check_combination(self) -> Any:
        if not (self.users or self.user_certificates) and self.anonymous == "no":
            raise ValueError(
                "nobody could log in: expected users:, user_certificates:, or anonymous: read or "
                "control"
            )
        if (self.certificate is None) != (self.key is None):
            raise ValueError("expected both certificate and key, or neither")
        return self
