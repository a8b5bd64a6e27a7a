"""The server's patience: a request is there within ten seconds, or its connection is closed.

uvicorn waits for the rest of a request as long as there is a connection, and a page on which every visitor can keep one
open by sending a byte now and then would run out of them.
"""

from __future__ import annotations

import asyncio
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

__all__ = ["PATIENCE_SECONDS", "PatientProtocol"]

PATIENCE_SECONDS = 10.0
"""From the connection, or the first byte of a further request, to the last byte of the request."""


class PatientProtocol(H11Protocol):
    """uvicorn's HTTP/1.1, whose patience has an end."""

    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        """The clock starts."""
        super().connection_made(transport)
        self._wait()

    def data_received(self, data: bytes) -> None:
        """It is stopped by the last byte of a request, and by no other."""
        super().data_received(data)
        if self.conn.their_state in (h11.IDLE, h11.SEND_BODY):
            self._wait()
        else:
            self._stop()

    def connection_lost(self, exc: Exception | None) -> None:
        """Nobody is waited for."""
        self._stop()
        super().connection_lost(exc)

    def _wait(self) -> None:
        if self._deadline is None:
            self._deadline = self.loop.call_later(PATIENCE_SECONDS, self.transport.close)

    def _stop(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None
