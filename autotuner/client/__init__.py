"""A client of the service for Python programs, synchronous and asynchronous.

    from autotuner.client import Client

    with Client("http://127.0.0.1:8321") as service:
        tuning = service.tune("TIC-101", goal="balanced")
        print(tuning.verdict.message, tuning.gains)

It needs httpx: `relay-autotuner[client]`.
"""

from autotuner.client.asynchronous import AsyncClient
from autotuner.client.errors import ServiceError, StreamError
from autotuner.client.synchronous import Client

__all__ = ["AsyncClient", "Client", "ServiceError", "StreamError"]
