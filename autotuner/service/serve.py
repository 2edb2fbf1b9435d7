"""Serving until a signal: `autotuner serve`.

Invariants:

1. SIGTERM, SIGINT and SIGHUP (a terminal that closes; not under `nohup`) end every tuning and restore its output BEFORE
   connections are waited for: a reader of live events must not keep a heater on. A second one ends the waiting for dead
   devices.
2. The socket listens before the application is started: a client that connects meanwhile waits for its answer.
3. One service a data directory: a second one would take the running tunings of the first for interrupted ones.
4. One line on standard output names the address, once all requests are answered; the log goes to standard error.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import gc
import json
import logging
import os
import signal
import socket
import ssl
import sys
from functools import partial
from logging.handlers import QueueHandler
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING

import uvicorn

from autotuner.control.clock.real_time import Upkeep
from autotuner.control.clock.ticker import clock
from autotuner.control.forced_shutdown import wait_no_more
from autotuner.control.records.device_lock import acquire, holder
from autotuner.control.reporting.line_writer import LineWriter
from autotuner.errors import ConfigurationError
from autotuner.service.app import create_app
from autotuner.service.connections import ConnectionMiddleware, Listener, connections_for
from autotuner.service.errors import ListenError
from autotuner.service.operations.logs import LogBudget, formatter, worth_a_line
from autotuner.service.operations.sd_notify import Attendance, ServiceManager
from autotuner.service.security.loopback import is_loopback
from autotuner.service.security.tokens import require_protection, tokens_of
from autotuner.stopped_by import stopped_by

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from types import FrameType

    from fastapi import FastAPI

    from autotuner.application.manager import Manager
    from autotuner.configuration import Configuration, ServiceTable
    from autotuner.service.connections import Connections

_log = logging.getLogger(__name__)

TICKS_A_SECOND = 10
"""Ticks of the server."""
OF_THE_PORT = (errno.EADDRINUSE, errno.EACCES)
"""Reasons why an address of this machine cannot be bound."""
CONNECTIONS_LIMIT_S = 5
"""Longest wait for open connections after the outputs are restored, s."""


def serve(
    configuration: Configuration, read_again: Callable[[], Configuration] | None = None, *, as_json: bool = False
) -> int:
    """Serve until a signal, and return the exit code.

    Parameters
    ----------
    configuration : Configuration
        What is served.
    read_again : callable, optional
        Reads the configuration again, for a reload.
    as_json : bool
        Whether the address is printed for programs: ``{"listening": ADDRESS}``.

    Raises
    ------
    ConfigurationError
        Other machines reach the host and there is no token, another service has the data directory, the certificate
        cannot be used, or a driver refuses its options.
    ListenError
        The address is in use or cannot be used.
    """
    service = configuration.service
    require_protection(service.host, loopback=is_loopback(service.host), tokens=tokens_of(service.data_directory))
    with _alone_in(service), _log_from_its_own_thread(service.log):
        return _serve(configuration, read_again, _as_json if as_json else partial(_for_people, configuration))


def _as_json(address: str) -> str:
    return json.dumps({"listening": address}) + "\n"


def _for_people(configuration: Configuration, address: str) -> str:
    count = len(configuration.loops)
    return f"autotuner serves {count} loop{'s' if count > 1 else ''} at {address} (Ctrl-C ends it)\n"


def _serve(
    configuration: Configuration, read_again: Callable[[], Configuration] | None, announce: Callable[[str], str]
) -> int:
    service = configuration.service
    connections = connections_for(service.connections_limit)
    certificate, private_key = _encryption(service)
    with Listener(_listen(service), connections) as listener, asyncio.Runner() as runner:
        app = create_app(configuration, read_configuration=read_again)
        settings = uvicorn.Config(
            ConnectionMiddleware(app, connections),
            log_config=None,
            http="h11",
            ws="none",
            lifespan="off",
            proxy_headers=False,
            server_header=False,
            timeout_graceful_shutdown=CONNECTIONS_LIMIT_S,
            ssl_certfile=certificate,
            ssl_keyfile=private_key,
        )
        server = _Server(settings, app, connections, announce)
        for number in stopped_by():  # uvicorn raises a signal again at its end: it must find a handler that returns
            signal.signal(number, server.handle_exit)
        runner.run(server.serve_app(listener))
    return 0


@contextlib.contextmanager
def _alone_in(service: ServiceTable) -> Iterator[None]:
    """Hold the data directory; one that cannot be written holds nothing that two could disturb."""
    path = Path(service.data_directory) / "locks" / "service"
    try:
        lock = acquire(path)
    except OSError:
        yield
        return
    if lock is None:
        raise ConfigurationError(
            f"is in use by another service ({holder(path)})",
            field="service.data_directory",
            value=service.data_directory,
            remedy="Use that one, or stop it first; a service for other devices needs its own data directory.",
        )
    with contextlib.suppress(OSError):  # it is for the message alone
        lock.mark(f"process {os.getpid()}, {service.host} port {service.port}")
    try:
        yield
    finally:
        lock.clear()
        lock.release()


@contextlib.contextmanager
def _log_from_its_own_thread(kind: str) -> Iterator[None]:
    """Write the log to standard error; whoever reads it, and whoever does not, holds nothing up."""
    records: SimpleQueue[logging.LogRecord] = SimpleQueue()
    writer, taker, root = LineWriter(records, formatter(kind)), QueueHandler(records), logging.getLogger()
    taker.addFilter(worth_a_line)
    taker.addFilter(LogBudget(clock, records))
    before = root.level
    root.setLevel(logging.INFO)
    root.addHandler(taker)
    writer.start()
    try:
        yield
    finally:
        root.removeHandler(taker)
        root.setLevel(before)
        writer.stop()


class _Server(uvicorn.Server):
    """Prints its address when it listens, and ends the tunings before it waits for anything."""

    def __init__(
        self,
        settings: uvicorn.Config,
        app: FastAPI,
        connections: Connections,
        announce: Callable[[str], str],
    ) -> None:
        super().__init__(settings)
        self._announce = announce
        self._app, self._connections = app, connections
        self._manager: Manager = app.state.manager
        self._attendance = Attendance(ServiceManager.of(os.environ, os.getpid()))
        self._upkeep = Upkeep(awake=False)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._second_request = asyncio.Event()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        if self.should_exit and self._loop is not None:
            with contextlib.suppress(RuntimeError):  # it has ended
                self._loop.call_soon_threadsafe(self._second_request.set)
        super().handle_exit(sig, frame)

    async def serve_app(self, listener: socket.socket) -> None:
        """Start the application, and serve it until a signal."""
        self._loop = asyncio.get_running_loop()
        self._attendance.starts()
        async with self._app.router.lifespan_context(self._app):
            await self.serve(sockets=[listener])

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        gc.collect()
        gc.freeze()  # imported objects stay: visiting them again takes a tenth of a second
        for listener in sockets or []:
            host, port = listener.getsockname()[:2]
            scheme = "https" if self.config.is_ssl else "http"
            with contextlib.suppress(OSError):  # a failure to print the address is ignored
                sys.stdout.write(self._announce(f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}"))
                sys.stdout.flush()
        self._attendance.is_ready()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._attendance.stops()
        self._connections.end()
        impatience = asyncio.create_task(self._wait_no_more())
        self._app.state.compute_queue.interrupt()  # requests wait for nothing any more
        await self._manager.close()
        impatience.cancel()
        await super().shutdown(sockets)
        await self._attendance.end()

    async def _wait_no_more(self) -> None:
        """Leave devices that do not answer to the next start, once the end is requested again."""
        await self._second_request.wait()
        _log.warning("the end was requested again: devices that do not answer are left to the next start")
        wait_no_more()

    async def on_tick(self, counter: int) -> bool:
        if counter % TICKS_A_SECOND == 0:
            self._connections.cut_idle(asyncio.get_running_loop().time())
            self._upkeep.look(busy=self._manager.busy)
        return await super().on_tick(counter)


def _encryption(service: ServiceTable) -> tuple[str | None, str | None]:
    """Return certificate and private key, None for HTTP; the files are tried here, for a clear error."""
    given = {"certificate": service.certificate, "private_key": service.private_key}
    if given["certificate"] is None and given["private_key"] is None:
        if not is_loopback(service.host):
            _log.warning("tokens travel unencrypted: set service.certificate and service.private_key")
        return None, None
    if service.certificate is None or service.private_key is None:
        missing = next(name for name, value in given.items() if value is None)
        raise ConfigurationError("is missing", field=f"service.{missing}", remedy="Give both files, or none.")
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(service.certificate, service.private_key)
    except OSError as error:
        raise ConfigurationError(
            f"cannot be used: {error.strerror or error}",
            field="service.certificate",
            value=service.certificate,
            remedy="Give a certificate and its private key as PEM files that the service may read.",
        ) from error
    return service.certificate, service.private_key


def _listen(service: ServiceTable) -> socket.socket:
    """Return a listening socket; the name localhost is not resolved, because the result could be another machine."""
    host = "127.0.0.1" if service.host == "localhost" else service.host
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        listener = socket.create_server((host, service.port), family=family)
    except OSError as error:
        raise _cannot_listen(service, error) from error
    # an answer is several small writes: none shall wait until the client has acknowledged the one before (40 ms)
    listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listener


def _cannot_listen(service: ServiceTable, error: OSError) -> ListenError:
    """Return the error of the port, or else of the address."""
    number = error.errno or 0
    message = os.strerror(number) if number > 0 else error.strerror  # that of a name that has no address is negative
    why = f"cannot listen on {service.host}: {message}"
    if number in OF_THE_PORT:
        return ListenError(
            why,
            field="service.port",
            value=service.port,
            remedy="Stop the other program, or choose another port (0: any).",
        )
    return ListenError(why, field="service.host", value=service.host, remedy="Give an address of this machine.")
