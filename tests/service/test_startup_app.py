"""The startup application, which answers while the real one is being loaded."""

import asyncio
import contextlib
import sys
import threading

import pytest
from fastapi import FastAPI

from autotuner.errors import ConfigurationError
from autotuner.service.startup_app import ALIVE, StartupApp


class Server:
    """What a server does with an ASGI application."""

    def __init__(self, startup_app):
        self.startup_app, self.news = startup_app, asyncio.Queue()
        self.told = []
        self.life = asyncio.create_task(startup_app({"type": "lifespan"}, self.news.get, self._tell))

    async def _tell(self, message):
        self.told.append(message["type"])

    async def get(self, path, method="GET"):
        sent = []

        async def send(message):
            sent.append(message)

        scope = {"type": "http", "path": path, "method": method, "headers": [], "query_string": b"", "state": {}}
        await self.startup_app(scope, asyncio.Queue().get, send)
        return sent[0]["status"], b"".join(message.get("body", b"") for message in sent)


def application(course):
    @contextlib.asynccontextmanager
    async def lifespan(_):
        course.append("started")
        yield
        course.append("stopped")

    app = FastAPI(lifespan=lifespan)

    @app.get("/other")
    async def other() -> int:
        return 7

    return app


async def test_it_answers_for_an_application_that_is_still_being_loaded():
    course, go_on = [], threading.Event()

    def load():
        go_on.wait()
        return application(course)

    server = Server(StartupApp(load))
    await server.news.put({"type": "lifespan.startup"})
    try:
        assert await server.get(ALIVE) == (200, b'{"status":"ok"}')
        assert await server.get(ALIVE, "HEAD") == (200, b"")
        waiting = asyncio.create_task(server.get("/other"))
        await asyncio.sleep(0)
        assert not waiting.done()
        assert server.told == ["lifespan.startup.complete"]
    finally:
        go_on.set()
    assert await waiting == (200, b"7")
    assert await server.get(ALIVE) == (404, b'{"detail":"Not Found"}'), "now the application answers itself"
    assert course == ["started"]
    await server.news.put({"type": "lifespan.shutdown"})
    await server.life
    assert (course, server.told[-1]) == (["started", "stopped"], "lifespan.shutdown.complete")


async def test_an_application_that_cannot_be_loaded_is_told():
    refusal = ConfigurationError("is not an installed driver", field="loops.x.driver", value="nix", remedy="Install.")

    def load():
        raise refusal

    startup_app = StartupApp(load)
    server = Server(startup_app)
    await server.news.put({"type": "lifespan.startup"})
    assert await startup_app.application() is None
    assert startup_app.fault is refusal
    assert await server.get("/other") == (503, b"")
    await server.life


@pytest.mark.realtime
def test_nothing_heavy_is_loaded_before_the_startup_app():
    import subprocess

    heavy = "{'numpy', 'scipy', 'fastapi', 'sqlalchemy', 'sklearn'}"
    code = f"import sys, autotuner.commands.serve, autotuner.service.serve; print({heavy} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout == "set()\n"


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
