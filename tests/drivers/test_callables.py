"""The driver `python`: functions of the user, plain and async, slow and broken, by name and as objects."""

import asyncio
import math
import threading
import time

import pytest

from autotuner.errors import ConfigurationError, DeviceRefusedError, DeviceTimeoutError, LinkError
from autotuner_drivers import callables, simulated
from autotuner_drivers.testing.conformance import Subject, run

RIG = """
import asyncio
held = {"output": 12.0, "mode": 1.0}
opened = 0
def read(): return 20.0 + held["output"]
async def write(value):
    await asyncio.sleep(0)
    held["output"] = value
def connect():
    global opened
    opened += 1
def mode(): return held["mode"]
def set_mode(value): held["mode"] = value
constant = 5
def create(options): return Whole(options["room"])
def broken(options): raise RuntimeError("no such rig")
class Whole:
    readable = frozenset({"pv"})
    writable = frozenset({"output"})
    def __init__(self, room): self.room = room
    async def open(self): pass
    async def read(self, names): return {name: self.room for name in names}
    async def write(self, values): pass
    async def close(self): pass
"""


@pytest.fixture
def rig(tmp_path, monkeypatch):
    """A module of the user, under a name that no other test has."""
    name = f"rig_{id(tmp_path)}"
    (tmp_path / f"{name}.py").write_text(RIG, encoding="utf-8")
    monkeypatch.setattr("sys.path", [*__import__("sys").path])
    return {"path": str(tmp_path), "read": f"{name}:read", "write": f"{name}:write"}, name


def made(read=lambda: 1.0, write=lambda _: None, **options):
    return callables.create({"read": read, "write": write} | options)


@pytest.mark.realtime
async def test_functions_are_found_by_name(rig):
    options, name = rig
    signals = {"auto": {"read": f"{name}:mode", "write": f"{name}:set_mode"}}
    backend = callables.create(options | {"open": f"{name}:connect", "signals": signals})
    assert (backend.readable, backend.writable) == ({"pv", "auto"}, {"output", "auto"})
    await backend.open()
    await backend.open()
    await backend.write({"auto": 0.0, "output": 30.0})
    assert await backend.read(["pv", "auto"]) == {"auto": 0.0, "pv": 50.0}
    await backend.close()
    assert __import__(name).opened == 1


@pytest.mark.virtual_time
async def test_a_factory_of_a_whole_driver(rig):
    options, name = rig
    backend = callables.create({"path": options["path"], "factory": f"{name}:create", "options": {"room": 21.0}})
    await backend.open()
    assert await backend.read(["pv"]) == {"pv": 21.0}


@pytest.mark.parametrize(
    ("change", "field", "part"),
    [
        ({"read": "nowhere_at_all:f"}, "read", "No module named"),
        ({"read": "math:no_such"}, "read", "no_such"),
        ({"read": "math:pi"}, "read", "cannot be called"),
        ({"read": "math"}, "read", "neither a function nor"),
        ({"read": 5}, "read", "neither a function nor"),
        ({"timeout_s": 0.0}, "timeout_s", "out of range"),
        ({"reed": "math:sin"}, "reed", "not a known key"),
        ({"signals": {"auto": {"red": "math:sin"}}}, "signals.auto.red", "not a known key"),
        ({"factory": "math:sin"}, "read", "not a known key"),
    ],
)
def test_a_wrong_table_is_refused_with_its_key(change, field, part):
    with pytest.raises(ConfigurationError) as refusal:
        callables.create({"read": "math:sin", "write": "math:cos"} | change)
    assert refusal.value.field == field
    assert part in str(refusal.value)


@pytest.mark.parametrize(("factory", "part"), [("broken", "no such rig"), ("read", "TypeError"), ("mode", "TypeError")])
def test_a_factory_that_makes_no_driver_is_refused(rig, factory, part):
    options, name = rig
    with pytest.raises(ConfigurationError, match=part):
        callables.create({"path": options["path"], "factory": f"{name}:{factory}"})


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    ("returned", "value"), [(3, 3.0), (True, 1.0), (math.inf, math.inf), (None, math.nan)], ids=repr
)
async def test_what_a_function_may_return(returned, value):
    backend = made(lambda: returned, threaded=False)
    await backend.open()
    (seen,) = (await backend.read(["pv"])).values()
    assert type(seen) is float
    assert seen == value or (math.isnan(seen) and math.isnan(value))


@pytest.mark.virtual_time
@pytest.mark.parametrize("returned", ["3.0", [1.0], {}, object()], ids=["text", "list", "dict", "object"])
async def test_what_is_no_number_is_refused(returned):
    backend = made(lambda: returned, threaded=False)
    await backend.open()
    with pytest.raises(DeviceRefusedError, match="not a number"):
        await backend.read(["pv"])


@pytest.mark.virtual_time
@pytest.mark.parametrize(
    ("error", "kind"),
    [(OSError("gone"), LinkError), (TimeoutError("late"), LinkError), (KeyError("x"), DeviceRefusedError)],
)
async def test_an_exception_is_an_error_of_the_port_with_its_cause(error, kind):
    def read():
        raise error

    backend = made(read, threaded=False)
    await backend.open()
    with pytest.raises(kind) as raised:
        await backend.read(["pv"])
    assert raised.value.__cause__ is error


@pytest.mark.virtual_time
async def test_an_async_function_that_never_ends_is_cancelled():
    ended = []

    async def read():
        try:
            await asyncio.sleep(1e6)
        finally:
            ended.append(True)

    backend = made(read, threaded=False, timeout_s=2.0)
    await backend.open()
    with pytest.raises(DeviceTimeoutError, match=r"did not end within 2 s"):
        await backend.read(["pv"])
    assert ended == [True]


@pytest.mark.realtime
async def test_a_slow_write_is_never_overtaken_and_a_late_one_never_made():
    gate, written = threading.Event(), []

    def write(value):
        if value == 1.0:
            gate.wait(5.0)
        written.append(value)

    backend = made(write=write, timeout_s=0.05)
    await backend.open()
    for value in (1.0, 2.0):  # the second waits behind the first, and has timed out before its turn
        with pytest.raises(DeviceTimeoutError):
            await backend.write({"output": value})
    await backend.close()
    await backend.open()
    restoring = asyncio.ensure_future(backend.write({"output": 3.0}))
    await asyncio.sleep(0.01)
    gate.set()
    await restoring
    await backend.close()
    assert written == [1.0, 3.0]


@pytest.mark.realtime
async def test_a_blocking_function_does_not_hold_up_the_event_loop():
    backend = made(lambda: time.sleep(0.3) or 1.0)  # noqa: TID251 - as a user's function may
    await backend.open()
    reading, turns = asyncio.ensure_future(backend.read(["pv"])), 0
    while not reading.done():
        await asyncio.sleep(0.01)
        turns += 1
    await backend.close()
    assert turns >= 10


@pytest.mark.realtime
async def test_all_functions_run_in_one_thread():
    threads = set()
    backend = made(lambda: threads.add(threading.get_ident()) or 1.0, lambda _: threads.add(threading.get_ident()))
    await backend.open()
    await asyncio.gather(*(backend.read(["pv"]) for _ in range(5)), backend.write({"output": 1.0}))
    await backend.close()
    assert len(threads) == 1
    assert threads != {threading.get_ident()}


def test_the_driver_conforms(virtual):
    plant = {"plant": {"structure": "fopdt", "K": 2.0, "T": 2.0, "D": 0.3}, "output0": 40.0, "pv0": 80.0, "noise": 0.05}
    device = simulated.create(plant)

    async def read(name):
        await device.open()
        return (await device.read([name]))[name]

    def create():
        return callables.create(
            {
                "read": lambda: read("pv"),
                "read_output": lambda: read("output"),
                "write": lambda value: device.write({"output": value}),
                "open": device.open,
                "signals": {"auto": {"read": lambda: read("auto"), "write": lambda v: device.write({"auto": v})}},
                "threaded": False,
            }
        )

    def absent():
        async def connect():
            raise ConnectionRefusedError("nobody there")

        return callables.create({"read": "math:sin", "write": "math:cos", "open": connect, "threaded": False})

    subject = Subject(create, 0.0, 100.0, 5.0, call_limit_s=5.0, beyond=(1e6, -1e6), unreachable=absent)
    outcomes = virtual(run(subject))
    assert [o for o in outcomes if o.passed is False] == []
