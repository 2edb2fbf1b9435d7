"""Pieces of a chunked answer, made once and written straight to the connections of many who get the same.

    chunk = size in hexadecimal CRLF piece CRLF              (RFC 9112, HTTP/1.1, section 7.1)

The usual way of a piece leads through every layer of the application and the server's framing, for each connection
anew: more work than the writing itself. The server's framing of a piece depends on nothing that came before, so that
pieces of both ways may follow each other; the beginning and the end of an answer go the usual way.

Rules of this file: it is asked for at the very connection (`autotuner.service.door`); where the server shows none that
can be written to, or the answer is not chunked, there is no straight way, and the usual one is taken.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

    from starlette.types import Scope, Send

STRAIGHT = "autotuner.straight"
"""Where a request's scope holds its straight way."""
NEEDED = ("transport", "flow", "disconnected")
"""What uvicorn's side of a request shows: the connection, whether it takes more, and whether it has ended."""


def chunk(piece: bytes) -> bytes:
    """Return a piece as it goes over the wire; nothing for an empty one, which would end the answer."""
    return b"%x\r\n%b\r\n" % (len(piece), piece) if piece else b""


def straight(scope: Scope, send: Send) -> Callable[[bytes], bool] | None:
    """Return what writes chunks to the connection of a request, None where there is no straight way.

    What is returned writes nothing, and says False, when the connection takes no more for now; who has gone is told
    nothing. It is to be called between the beginning and the end of an answer without a length.
    """
    request: Any = getattr(send, "__self__", None)
    if scope.get("http_version") != "1.1" or not all(hasattr(request, name) for name in NEEDED):
        return None

    def write(chunks: bytes) -> bool:
        if request.disconnected:
            return True
        if request.flow.write_paused:
            return False
        request.transport.write(chunks)
        return True

    return write
