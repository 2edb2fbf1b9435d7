"""Driver `python`: a loop of the user's own Python functions, from a configuration file or `autotuner.run()`.

Options (table ``[loops.NAME.device]``), with their defaults; a function is ``"module:name"``, or the function itself::

    read = "my_rig:read_temperature"    # returns the PV: a number, or None when there is none
    write = "my_rig:set_heater"         # takes the output
    read_output = "my_rig:get_heater"   # optional: returns the output
    open = "my_rig:connect"             # optional: called before the first read, and again after a lost link
    close = "my_rig:disconnect"         # optional
    factory = "my_rig:create"           # instead of the functions: returns an `autotuner.ports.Backend`
    options = { port = "COM3" }         # passed to `factory`; default none
    path = "/srv/rigs"                  # folder in which the modules are searched first; default none
    timeout_s = 5.0                     # longest time of one call
    threaded = true                     # false: plain functions run in the event loop, which they must never block

    [loops.NAME.device.signals]         # further signals, such as auto, set_point, kp; default none
    auto = { read = "my_rig:get_mode", write = "my_rig:set_mode" }

Invariants:

1. A function may be `async`. A plain function runs in one thread of the backend, so calls never overlap and a slow
function never delays another loop.
2. A call that has timed out or was cancelled while it was queued is never made later. A call that is still running
keeps the thread: the next call waits for it, so an older write never overtakes a newer one.
3. An exception of a function is a `DriverError` with its cause: a `LinkError` for `OSError` and `TimeoutError`.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import inspect
import math
import queue
import sys
import threading
from concurrent.futures import Future
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

from autotuner.errors import AutotunerError, DeviceRefusedError, DeviceTimeoutError, DriverError, LinkError
from autotuner.ports import OUTPUT, PV, Backend
from autotuner_drivers.options import Options, check_finite, check_names, refuse

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping

T = TypeVar("T")
LONGEST_TIMEOUT_S: Final = 3600.0
"""Longest time that may be set for a call, s: a function may drive a slow rig."""
_EXAMPLE: Final = 'Write "module:function", for instance "my_rig:read_temperature".'


class CallableBackend:
    """A loop driven by functions; implements `autotuner.ports.Backend`.

    Parameters
    ----------
    reads, writes : mapping
        Functions by signal: a read function takes no argument and returns a number, a write function takes the value.
    connect, disconnect : callable, optional
        Called by `open` and `close`.
    timeout_s : float
        Longest time of one call, s.
    threaded : bool
        Whether plain functions run in a thread.
    """

    def __init__(
        self,
        reads: Mapping[str, Callable[[], Any]],
        writes: Mapping[str, Callable[[float], Any]],
        *,
        connect: Callable[[], Any] | None = None,
        disconnect: Callable[[], Any] | None = None,
        timeout_s: float = 5.0,
        threaded: bool = True,
    ) -> None:
        self._reads, self._writes = dict(reads), dict(writes)
        self._connect, self._disconnect = connect, disconnect
        self._timeout_s, self._threaded = timeout_s, threaded
        self._turn = asyncio.Lock()
        self._worker: Worker | None = None
        self._opened = False
        self.moment_s = math.nan

    @property
    def readable(self) -> frozenset[str]:
        """Signals with a function that reads them."""
        return frozenset(self._reads)

    @property
    def writable(self) -> frozenset[str]:
        """Signals with a function that writes them."""
        return frozenset(self._writes)

    async def open(self) -> None:
        """Call the function that connects, once."""
        async with self._turn:
            if self._opened:
                return
            if self._threaded and self._worker is None:
                self._worker = Worker("python driver")
            if self._connect is not None:
                await self._call("open", self._connect)
            self._opened = True

    async def read(self, names: Collection[str]) -> dict[str, float]:
        """Return the value of each named signal, the PV last and so nearest to the next write."""
        check_names(names, self.readable, "read")
        values = {}
        async with self._turn:
            for name in sorted(names, key=lambda name: name == PV):
                values[name] = number_of(name, await self._timed(f"read of {name}", self._reads[name]))
        return values

    async def write(self, values: Mapping[str, float]) -> None:
        """Set the named signals in the order given."""
        check_names(values, self.writable, "write")
        check_finite(values)
        async with self._turn:
            for name, value in values.items():
                await self._timed(f"write of {name}", self._writes[name], value)

    async def close(self) -> None:
        """Call the function that disconnects, if the backend is open; never raises."""
        async with self._turn:
            opened, self._opened = self._opened, False
            if opened and self._disconnect is not None:
                with contextlib.suppress(AutotunerError):
                    await self._call("close", self._disconnect)
            if self._worker is not None and not self._worker.busy:  # a busy one is kept, see invariant 2
                self._worker.stop()
                self._worker = None

    async def _timed(self, action: str, function: Callable[..., Any], *arguments: float) -> Any:
        """Call a function of an open backend, and record the middle of the call in `moment_s`."""
        if not self._opened:
            raise LinkError("the python driver is not open", remedy="Open the backend first.")
        clock = asyncio.get_running_loop().time
        started_s = clock()
        value = await self._call(action, function, *arguments)
        self.moment_s = (started_s + clock()) / 2.0
        return value

    async def _call(self, action: str, function: Callable[..., Any], *arguments: float) -> Any:
        name = getattr(function, "__qualname__", None) or type(function).__name__
        try:
            async with asyncio.timeout(self._timeout_s) as limit:
                return await self._run(function, *arguments)
        except AutotunerError:
            raise
        except TimeoutError as error:
            if limit.expired():
                raise DeviceTimeoutError(
                    f"the {action} by {name} did not end within {self._timeout_s:g} s",
                    remedy="Make the function faster, give it a time limit of its own, or raise timeout_s.",
                ) from error
            raise _error(LinkError, action, name, error) from error
        except OSError as error:
            raise _error(LinkError, action, name, error) from error
        except Exception as error:
            raise _error(DeviceRefusedError, action, name, error) from error

    async def _run(self, function: Callable[..., Any], *arguments: float) -> Any:
        if inspect.iscoroutinefunction(function) or self._worker is None:
            result = function(*arguments)
        else:
            result = await asyncio.wrap_future(self._worker.submit(function, *arguments))
        return await result if inspect.isawaitable(result) else result


class Worker:
    """A thread that makes calls one after another. A daemon: a function that never ends cannot block exit.

    Parameters
    ----------
    name : str
        Name of the thread.
    """

    def __init__(self, name: str) -> None:
        self._calls: queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None] = queue.SimpleQueue()
        self.busy = False
        threading.Thread(target=self._work, name=name, daemon=True).start()

    def submit(self, function: Callable[..., T], *arguments: Any) -> Future[T]:
        """Queue a call; a future that is cancelled while it is queued is never called."""
        future: Future[T] = Future()
        self._calls.put((future, lambda: function(*arguments)))
        return future

    def stop(self) -> None:
        """End the thread after the current call."""
        self._calls.put(None)

    def _work(self) -> None:
        while (item := self._calls.get()) is not None:
            future, call = item
            if not future.set_running_or_notify_cancel():
                continue
            self.busy = True
            try:
                result = call()
            except BaseException as error:  # noqa: BLE001 - it belongs to the caller
                self.busy = False
                _settle(future.set_exception, error)
            else:
                self.busy = False
                _settle(future.set_result, result)


def _settle(settle: Callable[[Any], None], value: object) -> None:
    with contextlib.suppress(RuntimeError):  # the waiting event loop has been closed
        settle(value)


def _error(kind: type[DriverError], action: str, name: str, error: Exception) -> DriverError:
    return kind(
        f"the {action} by {name} raised {type(error).__name__}: {error}",
        remedy="Correct the function, or check what it returns.",
    )


def number_of(name: str, value: object) -> float:
    """Convert a function's result to float: NaN for None; raise `DeviceRefusedError` unless it is a number."""
    if value is None:
        return math.nan
    try:
        return float(cast("float", value)) if not isinstance(value, str | bytes) else _not_a_number(name, value)
    except (TypeError, ValueError) as error:
        return _not_a_number(name, value, error)


def _not_a_number(name: str, value: object, cause: Exception | None = None) -> float:
    raise DeviceRefusedError(
        "was read by a function whose result is not a number",
        field=name,
        value=value,
        remedy="Return a float, or None when there is no value.",
    ) from cause


def create(options: Mapping[str, object]) -> Backend:
    """Return a closed backend for the options of a loop's device.

    Raises
    ------
    ConfigurationError
        Names the key, the value and the remedy; nothing has been called, but modules have been imported.
    """
    table = Options(options)
    if "path" in table and (path := table.text("path")) not in sys.path:
        sys.path.insert(0, path)
    return _from_factory(table) if "factory" in table else _from_functions(table)


def _from_factory(table: Options) -> Backend:
    factory = _function(table, "factory")
    options = table.table("options", {}).values
    table.done()
    try:
        backend = factory(options)
    except AutotunerError:
        raise
    except Exception as error:  # noqa: BLE001 - whatever the user's factory raises
        refuse("factory", table.value("factory"), f"raised {type(error).__name__}: {error}", "Correct the factory.")
    if not isinstance(backend, Backend):
        refuse(
            "factory",
            type(backend).__name__,
            "returns no autotuner.ports.Backend",
            "Return an object with readable, writable, open, read, write and close.",
        )
    return backend


def _from_functions(table: Options) -> CallableBackend:
    reads, writes = {PV: _function(table, "read")}, {OUTPUT: _function(table, "write")}
    if "read_output" in table:
        reads[OUTPUT] = _function(table, "read_output")
    signals = table.table("signals", {})
    for name in signals:
        signal = signals.table(name)
        for functions, key in ((reads, "read"), (writes, "write")):
            if key in signal:
                functions[name] = _function(signal, key)
        signal.done()
    backend = CallableBackend(
        reads,
        writes,
        connect=_function(table, "open") if "open" in table else None,
        disconnect=_function(table, "close") if "close" in table else None,
        timeout_s=table.number("timeout_s", 5.0, low=0.001, high=LONGEST_TIMEOUT_S, unit="s"),
        threaded=table.flag("threaded", default=True),
    )
    table.done()
    return backend


def _function(table: Options, key: str) -> Callable[..., Any]:
    """Take a function, or the name of one."""
    value = table.value(key)
    if callable(value):
        return value
    if not isinstance(value, str) or not all(value.partition(":")):
        refuse(table.key(key), value, "is neither a function nor the name of one", _EXAMPLE)
    module, _, name = value.partition(":")
    try:
        found: Any = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError, SyntaxError, ValueError) as error:
        refuse(table.key(key), value, f"cannot be loaded: {error}", "Correct the name, or set `path` to its folder.")
    except Exception as error:  # noqa: BLE001 - whatever the user's module raises when it is imported
        refuse(table.key(key), value, f"raised {type(error).__name__} when it was imported: {error}", _EXAMPLE)
    if not callable(found):
        refuse(table.key(key), value, f"is a {type(found).__name__}, which cannot be called", _EXAMPLE)
    return cast("Callable[..., Any]", found)
