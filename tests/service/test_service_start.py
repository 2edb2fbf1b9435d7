"""The start of the service: what is answered meanwhile, what ends it, and what it loads."""

import asyncio
import contextlib
import gc
import socket
import sys
from types import SimpleNamespace

import pytest
import uvicorn
from fastapi import FastAPI

from autotuner.errors import ConfigurationError
from autotuner.service.connections import ConnectionMiddleware, Connections, Listener
from autotuner.service.serve import _Server

LIMIT_S = 20.0
"""Longest wait for an answer on a loaded machine, s."""


class Manager:
    """What the server asks of a manager."""

    busy = False

    async def close(self):
        pass


@pytest.fixture
def server():
    """Return a function that makes the server of an application's lifespan, its listener and what it announces."""
    with contextlib.ExitStack() as sockets:

        def make(lifespan):
            app = FastAPI(lifespan=lifespan)
            app.state.manager, app.state.compute_queue = Manager(), SimpleNamespace(interrupt=lambda: None)

            @app.get("/healthz")
            async def healthz() -> int:
                return 7

            connections, announced = Connections(10), []
            listener = sockets.enter_context(Listener(socket.create_server(("127.0.0.1", 0)), connections))
            listener.setblocking(False)
            settings = uvicorn.Config(ConnectionMiddleware(app, connections), log_config=None, lifespan="off")
            return (
                _Server(settings, app, connections, lambda address: announced.append(address) or ""),
                listener,
                announced,
            )

        yield make
    gc.unfreeze()  # the server has frozen what was there


@pytest.mark.realtime
async def test_a_client_that_connects_during_the_start_is_answered_after_it(server):
    go_on, course = asyncio.Event(), []

    @contextlib.asynccontextmanager
    async def lifespan(_):
        await go_on.wait()
        course.append("started")
        yield
        course.append("stopped")

    serving, listener, announced = server(lifespan)
    async with asyncio.timeout(LIMIT_S):
        life = asyncio.create_task(serving.serve_app(listener))
        reader, writer = await asyncio.open_connection(*listener.getsockname())
        writer.write(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
        assert (announced, course) == ([], [])
        go_on.set()
        answer = await reader.read()
        writer.close()
        assert answer.startswith(b"HTTP/1.1 200 ")
        assert answer.endswith(b"\r\n\r\n7")
        assert announced == [f"http://127.0.0.1:{listener.getsockname()[1]}"]
        serving.should_exit = True
        await life
    assert course == ["started", "stopped"]


async def test_an_application_that_cannot_be_started_ends_the_service(server):
    refusal = ConfigurationError("is not an installed driver", field="loops.x.driver", value="nix", remedy="Install.")

    @contextlib.asynccontextmanager
    async def lifespan(_):
        raise refusal
        yield

    serving, listener, announced = server(lifespan)
    with pytest.raises(ConfigurationError) as raised:
        await serving.serve_app(listener)
    assert raised.value is refusal
    assert announced == []


@pytest.mark.realtime
def test_what_only_workers_need_is_not_in_the_memory_of_a_service_that_keeps_something(tmp_path):
    import subprocess

    code = f"""
import sys
from pathlib import Path
from autotuner.configuration import DEMO, parse_configuration
from autotuner.service.app import create_app
from autotuner.service.archive.storage.database_address import address_of
from autotuner.service.archive.storage.database import Database
create_app(parse_configuration(DEMO | {{"service": {{"data_directory": {str(tmp_path)!r}}}}}, "demo"))
Database(address_of(Path({str(tmp_path)!r}), None)).close()
heavy = ("sqlalchemy", "sklearn", "scipy.optimize", "scipy.signal", "matplotlib", "autotuner.core.diagnosis.procedure")
print([name for name in (*heavy, "autotuner.core.identification.procedure", "autotuner.core.design.pid_design",
                         "autotuner.reports.tuning") if name in sys.modules])
"""
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout == "[]\n"
