"""The application: the manager's work over HTTP.

Invariants:

1. A thin layer: `autotuner.application.manager.Manager` executes the requests.
2. Every endpoint and dependency is `async def`, and none blocks: the fronts of all operations live on this event loop.
3. When the application stops, every output has been restored first. Loops that a killed service left disturbed are
   restored, and held, before the first request is answered.
"""

from __future__ import annotations

from contextlib import asynccontextmanager
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from fastapi import FastAPI
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from autotuner.application.computing.compute_pool import NICENESS_OF_VIEWS, Workers
from autotuner.application.manager import Manager, random_id
from autotuner.service.archive.archive import Archive
from autotuner.service.archive.retention import Retention
from autotuner.service.context import tuning_seen
from autotuner.service.description import described
from autotuner.service.events import live
from autotuner.service.idempotency import IdempotencyKeys
from autotuner.service.operations.compute_queue import ComputeQueue
from autotuner.service.operations.history import Analyses
from autotuner.service.operations.metrics import Metrics
from autotuner.service.operations.watch_list import WatchList, watch_on
from autotuner.service.page import router as page
from autotuner.service.problems import ANY_PROBLEM, install
from autotuner.service.routes import (
    analyses,
    exports,
    gains,
    health,
    loops,
    monitors,
    pictures,
    recordings,
    reload,
    reports,
    schedules,
    tunings,
)
from autotuner.service.security import loopback
from autotuner.service.security.access import Gate, Quotas
from autotuner.service.security.audit import Audit
from autotuner.service.security.tokens import tokens_of

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from autotuner.configuration import Configuration, ServiceTable
    from autotuner.control.compute_port import ComputePool

WORKERS = 2
"""Worker processes for tunings, and as many for requests; each is started when it is first needed."""
ROUTERS = (
    health.router,  # first, because it is requested the most often
    gains.router,
    schedules.router,
    monitors.router,
    loops.router,
    loops.now,
    tunings.router,
    live.router,
    recordings.router,
    pictures.router,
    reports.router,
    analyses.identifications,
    analyses.diagnoses,
    exports.router,
    reload.router,
)
"""In the order of matching: names of loops may have slashes, so longer paths come first."""


def create_app(
    configuration: Configuration,
    pool: ComputePool | None = None,
    new_id: Callable[[], str] = random_id,
    read_configuration: Callable[[], Configuration] | None = None,
) -> FastAPI:
    """Return the service of a configuration.

    Parameters
    ----------
    configuration : Configuration
        The loops, and the limits of the service.
    pool : ComputePool, optional
        Where identification runs; worker processes by default.
    new_id : callable
        Makes identifiers of tunings.
    read_configuration : callable, optional
        Reads the configuration again, for a reload.

    Raises
    ------
    ConfigurationError
        A driver is unknown or refuses its options, or the trained corrections cannot be used.
    """
    service = configuration.service
    if configuration.learned.artefacts is not None:
        from autotuner.application.analysis.learned import use_artefacts  # noqa: PLC0415 - brings SciPy with it

        use_artefacts(configuration.learned.artefacts)
    app = bare_app()
    app.state.manager = Manager(configuration, pool or Workers(WORKERS), new_id)
    in_place = pool is not None  # virtual time has no threads
    app.state.archive = _archive(service, in_place=in_place)
    app.state.read_configuration = read_configuration
    app.state.metrics = Metrics()
    app.state.analyses = Analyses()
    app.state.compute_queue = ComputeQueue(pool or Workers(WORKERS, NICENESS_OF_VIEWS))
    app.state.idempotency_keys = IdempotencyKeys(Path(service.data_directory) / "idempotency.json", in_place=in_place)
    app.state.watch_list = WatchList(Path(service.data_directory) / "watched.json")
    app.add_middleware(
        Gate,
        hosts=loopback.NAMES | {service.host.lower(), *(name.lower() for name in service.names)},
        any_address=not loopback.is_loopback(service.host),
        tokens=tokens_of(service.data_directory, required=not loopback.is_loopback(service.host)),
        quotas=Quotas.of(
            service, dict.fromkeys((analyses.IDENTIFICATIONS, analyses.DIAGNOSES), service.upload_limit_bytes)
        ),
    )
    app.add_middleware(Audit, note=app.state.archive.note, manager=app.state.manager)
    if service.proxies:
        app.add_middleware(ProxyHeadersMiddleware, trusted_hosts=list(service.proxies))
    return app


def _archive(service: ServiceTable, *, in_place: bool) -> Archive:
    folder = Path(service.data_directory)
    retention = Retention(service.keep_tunings, service.keep_bytes)
    return Archive(service.database_url, folder, retention, in_place=in_place)


def bare_app() -> FastAPI:
    """Return the endpoints without loops and without the gate, as the API document describes them."""
    app = FastAPI(
        title="relay-autotuner",
        summary="Tunes control loops with a relay test",
        version=version("relay-autotuner"),
        lifespan=_lifespan,
        docs_url=None,  # the framework's own pages load their scripts from the internet
        redoc_url=None,
        responses=ANY_PROBLEM,
        generate_unique_id_function=lambda route: route.name,
    )
    install(app)
    for router in ROUTERS:
        app.include_router(router)
    app.include_router(page)
    describe = app.openapi
    app.openapi = lambda: described(describe())  # type: ignore[method-assign]
    return app


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    manager, archive = app.state.manager, app.state.archive
    try:
        manager.open()
        archive.open(manager)
        manager.store = archive.flush
        await watch_on(app.state.watch_list, manager, lambda name: tuning_seen(name, manager, archive))
        yield
    finally:
        app.state.compute_queue.interrupt()  # requests wait for nothing any more
        await manager.close()
        app.state.compute_queue.close()
        await archive.close()
