"""Count the outcomes of a gateway's requests and parts, the workpieces in the camera's results."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(slots=True)
class GatewayCounts:
    """The counts of a gateway's requests and answers.

    ``requests == answered + errors + abandoned + open``, and
    ``parts == delivered + forgotten + waiting``, at any time.

    Attributes:
        robots: connections that were accepted.
        refused: connections that were refused, since too many were open.
        requests: requests that came.
        answered: requests that were answered with a part, or with the state or reason asked for.
        errors: requests that were answered with an error.
        abandoned: requests that were never answered: the robot disconnected, or the gateway closed
            the connection, before the answer.
        open: requests that are not answered yet.
        parts: parts in all results that were made for robots' requests.
        delivered: parts that were sent to a robot.
        forgotten: parts that no robot asked for before a newer result came, the robot left, or they
            became too old.
        waiting: parts that a robot may still ask for.
    """

    robots: int = 0
    refused: int = 0
    requests: int = 0
    answered: int = 0
    errors: int = 0
    abandoned: int = 0
    open: int = 0
    parts: int = 0
    delivered: int = 0
    forgotten: int = 0
    waiting: int = 0
