"""The conformance kit passes our drivers, and names the check that a bad driver fails."""

import argparse
import asyncio
import contextlib
import json
import time

import pytest

from autotuner.errors import DeviceRefusedError, LinkError
from autotuner_drivers import modbus, serial, simulated
from autotuner_drivers.serial.backend import SerialBackend
from autotuner_drivers.serial.link import SerialLink, Timing
from autotuner_drivers.serial.tclab import TcLab
from autotuner_drivers.testing.commands import conformance_command as command
from autotuner_drivers.testing.conformance import CHECKS, Subject, run
from autotuner_drivers.testing.link import TcpLink
from autotuner_sim.devices.loop_device import LoopDevice
from autotuner_sim.devices.plc import SimulatedPlc, serving_tcp
from autotuner_sim.plants import Fopdt
from autotuner_sim.stepped import SteppedPlant

SIMULATED = {"plant": {"structure": "fopdt", "K": 2.0, "T": 2.0, "D": 0.3}, "output0": 40.0, "pv0": 80.0, "noise": 0.05}


def subject(create, **changes):
    return Subject(**({"create": create, "low": 0.0, "high": 100.0, "step": 5.0, "call_limit_s": 5.0} | changes))


def failures(outcomes):
    return {outcome.check: outcome.found for outcome in outcomes if outcome.passed is False}


def skipped(outcomes):
    return {outcome.check for outcome in outcomes if outcome.passed is None}


def test_the_simulated_driver_conforms(virtual):
    outcomes = virtual(run(subject(lambda: simulated.create(SIMULATED), beyond=(1e6, -1e6))))
    assert failures(outcomes) == {}
    assert skipped(outcomes) == {"an absent device is a link error", *LINK_CHECKS}


def test_the_modbus_driver_conforms(virtual, default_map):
    async def main():
        plant = SteppedPlant(Fopdt(2.0, 2.0, 0.3), output0=40.0, pv0=80.0)
        async with serving_tcp(SimulatedPlc(LoopDevice(plant)), "plc", 1502):
            here = {"host": "plc", "port": 1502, "registers": default_map}
            return await run(
                subject(
                    lambda: modbus.create(here),
                    beyond=(1000.0, -1000.0, 1e6),
                    unreachable=lambda: modbus.create(here | {"port": 1503}),
                )
            )

    outcomes = virtual(main())
    assert failures(outcomes) == {}
    assert skipped(outcomes) == {*LINK_CHECKS}


@pytest.mark.realtime
async def test_the_serial_driver_conforms(peer, tmp_path):
    port = tmp_path / "ttyPEER"
    peer("serial_peer.py", "--protocol", "eurotherm", "--link", port, "--plant", 2, 1, 0.1)
    here = {"protocol": "eurotherm", "serial_port": str(port), "timeout_s": 0.5}
    outcomes = await run(
        subject(
            lambda: serial.create(here),
            unreachable=lambda: serial.create(here | {"serial_port": str(tmp_path / "none")}),
        )
    )
    assert failures(outcomes) == {}
    assert skipped(outcomes) == {*LINK_CHECKS}


class Wrapped:
    """A backend that passes everything on to another: bad drivers override one call."""

    def __init__(self, inner=None):
        self.inner = inner or simulated.create(SIMULATED)

    @property
    def readable(self):
        return self.inner.readable

    @property
    def writable(self):
        return self.inner.writable

    async def open(self):
        await self.inner.open()

    async def read(self, names):
        return await self.inner.read(names)

    async def write(self, values):
        await self.inner.write(values)

    async def close(self):
        await self.inner.close()


class ReadsNothing(Wrapped):
    @property
    def readable(self):
        return frozenset()


class GivesMore(Wrapped):
    async def read(self, names):
        return await self.inner.read(names) | {"bonus": 1.0}


class GivesIntegers(Wrapped):
    async def read(self, names):
        return {name: int(value) for name, value in (await self.inner.read(names)).items()}


class GivesOldValues(Wrapped):
    kept = None

    async def read(self, names):
        values = await self.inner.read(names)
        if "pv" in values:
            self.kept = values["pv"] if self.kept is None else self.kept
            values["pv"] = self.kept
        return values


class LosesWrites(Wrapped):
    async def write(self, values):
        await self.inner.write({name: value for name, value in values.items() if name != "output"})


class TakesNoNumber(Wrapped):
    async def write(self, values):
        await self.inner.write({name: 0.0 if value != value else value for name, value in values.items()})  # noqa: PLR0124


class Wraps(Wrapped):
    """As an integer register that wraps around: -1 becomes the highest value."""

    lost = 0.0

    async def write(self, values):
        await self.inner.write(values)
        self.lost = values.get("output", 0.0) % 65536.0

    async def read(self, names):
        values = await self.inner.read(names)
        return values | {"output": self.lost} if "output" in values and self.lost > 1000.0 else values


class ForgetsTheMode(Wrapped):
    async def write(self, values):
        await self.inner.write({name: value for name, value in values.items() if name != "auto"})


class InventsSignals(Wrapped):
    async def read(self, names):
        known = await self.inner.read([name for name in names if name in self.readable])
        return {name: known.get(name, 0.0) for name in names}


class ReadsWhenClosed(Wrapped):
    async def read(self, names):
        try:
            return await self.inner.read(names)
        except LinkError:
            return dict.fromkeys(names, 0.0)


class LetsSocketErrorsThrough(Wrapped):
    async def read(self, names):
        try:
            return await self.inner.read(names)
        except LinkError as error:
            raise ConnectionResetError from error


class ClosesOnce(Wrapped):
    closed = False

    async def close(self):
        if self.closed:
            raise DeviceRefusedError("is closed already", remedy="Close once.")
        self.closed = True
        await self.inner.close()


class HangsForEver(Wrapped):
    async def read(self, names):
        await asyncio.Event().wait()


class SwallowsCancellation(Wrapped):
    """Behind a cancelled read the answer that was left on the line comes first."""

    stale = None

    async def read(self, names):
        if self.stale is not None:
            stale, self.stale = self.stale, None
            return dict.fromkeys(names, stale)
        values = await self.inner.read(names)
        try:
            await asyncio.sleep(0.01)
        except asyncio.CancelledError:
            self.stale = values["pv"]
            raise
        return values


class MixesCalls(Wrapped):
    """Keeps what was asked in the object instead of in the call."""

    async def read(self, names):
        self.asked = list(names)
        await asyncio.sleep(0.01)
        return await self.inner.read(self.asked)


class Blocks(Wrapped):
    async def read(self, names):
        time.sleep(0.4)  # noqa: ASYNC251, TID251 - this is what a bad driver does
        return await self.inner.read(names)


class OpensWhatIsNotThere(Wrapped):
    pass


class Wire:
    """A link in memory."""

    state = "whole"

    async def cut(self):
        self.state = "cut"

    async def hold(self):
        self.state = "held"

    async def restore(self):
        self.state = "whole"


class OverWire(Wrapped):
    """A driver that keeps the rules over a link that may be cut or held; bad ones override what they do wrong."""

    wire = Wire()

    def __init__(self):
        super().__init__(simulated.create(SIMULATED))

    async def _pass(self):
        if self.wire.state == "held":
            await asyncio.sleep(1.0)
        if self.wire.state != "whole":
            raise LinkError("the link is lost", remedy="Mend it.") from ConnectionResetError()

    async def open(self):
        await self._pass()
        await self.inner.open()

    async def read(self, names):
        await self._pass()
        return await self.inner.read(names)

    async def write(self, values):
        await self._pass()
        await self.inner.write(values)


class NanWhenLost(OverWire):
    async def read(self, names):
        try:
            return await super().read(names)
        except LinkError:
            return dict.fromkeys(names, float("nan"))


class OldValuesWhenLost(OverWire):
    kept = None

    async def read(self, names):
        with contextlib.suppress(LinkError):
            self.kept = await super().read(sorted(self.readable))
        return {name: self.kept[name] for name in names}


class OtherErrorWhenLost(OverWire):
    async def _pass(self):
        try:
            await super()._pass()
        except LinkError as error:
            raise DeviceRefusedError("is refused", remedy="Ask again.") from error


class NeverMends(OverWire):
    broken = False

    async def _pass(self):
        try:
            await super()._pass()
            if self.broken:
                raise LinkError("the session is gone", remedy="None.")  # noqa: TRY301
        except LinkError:
            self.broken = True
            raise


class WaitsForTheLink(OverWire):
    async def write(self, values):
        while self.wire.state == "held":  # noqa: ASYNC110
            await asyncio.sleep(0.1)
        await super().write(values)


class SaysDoneWhenHeld(OverWire):
    async def write(self, values):
        if self.wire.state != "held":
            await super().write(values)


class RaisesAtClose(OverWire):
    async def close(self):
        await self._pass()
        await self.inner.close()


@pytest.fixture(autouse=True)
def whole_wire():
    OverWire.wire = Wire()


def test_a_driver_that_keeps_the_rules_of_a_lost_link_passes(virtual):
    outcomes = virtual(run(subject(OverWire, link=OverWire.wire)))
    assert failures(outcomes) == {}
    assert skipped(outcomes) == {"an absent device is a link error"}


@pytest.mark.parametrize(
    ("driver", "check", "found"),
    [
        (NanWhenLost, "a lost link is an error", "reads as NaN"),
        (OldValuesWhenLost, "a lost link is an error", "continued for 5 s"),
        (OtherErrorWhenLost, "a lost link is an error", "is a DeviceRefusedError"),
        (NeverMends, "a lost link is an error", "do not restore the link"),
        (WaitsForTheLink, "an answer that blocks is an error", "did not end within 5 s"),
        (SaysDoneWhenHeld, "an answer that blocks is an error", "returned None where LinkError is due"),
        (RaisesAtClose, "a lost link while closed is none", "raised LinkError"),
    ],
)
def test_what_a_bad_driver_makes_of_a_lost_link(virtual, driver, check, found):
    assert found in failures(virtual(run(subject(driver, link=OverWire.wire), [check])))[check]


@pytest.mark.realtime
async def test_the_modbus_driver_conforms_over_a_link_that_is_cut_and_held(default_map, free_port):
    plant = SteppedPlant(Fopdt(2.0, 2.0, 0.3), output0=40.0, pv0=80.0)
    async with serving_tcp(SimulatedPlc(LoopDevice(plant)), "127.0.0.1", free_port):
        link = TcpLink("127.0.0.1", free_port)
        await link.start()
        here = {"host": "127.0.0.1", "port": link.port, "timeout_s": 0.5, "registers": default_map}
        outcomes = await run(subject(lambda: modbus.create(here), link=link), LINK_CHECKS)
        await link.close()
    assert [outcome for outcome in outcomes if outcome.passed is not True] == []


BAD = {
    "port": ReadsNothing,
    "read returns what was requested": GivesMore,
    "reads advance": GivesOldValues,
    "writes take effect": LosesWrites,
    "limits are kept": TakesNoNumber,
    "mode is taken and restored": ForgetsTheMode,
    "unknown signals are refused": InventsSignals,
    "closed is an error": ReadsWhenClosed,
    "open and close may be repeated": ClosesOnce,
    "cancelled calls leave the line usable": SwallowsCancellation,
    "calls at once do not mix": MixesCalls,
    "an absent device is a link error": OpensWhatIsNotThere,
}


@pytest.mark.parametrize("check", BAD)
def test_a_bad_driver_is_told_by_the_name_of_the_check(virtual, check):
    outcomes = virtual(run(subject(BAD[check], unreachable=BAD[check])))
    assert check in failures(outcomes)
    assert failures(outcomes)[check]


LINK_CHECKS = ("a lost link is an error", "an answer that blocks is an error", "a lost link while closed is none")


def test_every_check_has_a_driver_that_fails_it():
    assert set(BAD) | {"the loop goes on", *LINK_CHECKS} == set(CHECKS)


@pytest.mark.parametrize(
    ("driver", "check", "found"),
    [
        (GivesIntegers, "read returns what was requested", "not floats"),
        (LetsSocketErrorsThrough, "closed is an error", "ConnectionResetError where DriverError"),
        (HangsForEver, "reads advance", "did not end within 5 s"),
        (Wraps, "limits are kept", "beyond 0 to 100"),
    ],
)
def test_further_ways_to_be_bad(virtual, driver, check, found):
    assert found in failures(virtual(run(subject(driver, beyond=(-1.0,)))))[check]


@pytest.mark.realtime
async def test_a_driver_that_blocks_the_event_loop_is_told():
    (outcome,) = await run(subject(Blocks), ["the loop goes on"])
    assert outcome.passed is False
    assert "the event loop was blocked for 0." in outcome.found


def test_bad_modbus(virtual, default_map):
    """An output that is mapped to the register of the set point moves nothing."""

    async def main():
        plant = SteppedPlant(Fopdt(2.0, 2.0, 0.3), output0=40.0, pv0=80.0)
        async with serving_tcp(SimulatedPlc(LoopDevice(plant)), "plc", 1502):
            off = default_map | {"output": default_map["set_point"], "set_point": default_map["output"]}
            return await run(subject(lambda: modbus.create({"host": "plc", "port": 1502, "registers": off})))

    assert "reads advance" in failures(virtual(main()))


def test_bad_serial(virtual):
    """A port that answers each command with the answer to the one before."""

    class Echo:
        answers = (b"TCLab\r\n",)

        async def open(self):
            self.pending = b""

        async def write(self, message):
            self.pending = b"12.000\r\n"

        async def read(self, wait_s):
            await asyncio.sleep(min(wait_s, 0.02))
            pending, self.pending = self.pending, b""
            return pending

        async def clear(self):
            self.pending = b""

        async def close(self):
            self.pending = b""

    def create():
        protocol = TcLab(1, 200.0, 3, read_back=True)
        backend = SerialBackend(SerialLink(Echo(), "echo", Timing(0.2, 0.2, 0.05, 0.0), protocol.split), protocol, 0)
        backend._protocol.settle_s = 0.0
        backend._protocol.enter = lambda: protocol.leave(0.0)
        return backend

    failed = failures(virtual(run(subject(create, response_s=5.0))))
    assert "writes take effect" in failed
    assert "reads advance" in failed


def run_command(capsys, *arguments):
    parser = argparse.ArgumentParser()
    command.configure(parser)
    code = command.run(parser.parse_args(arguments))
    return code, *capsys.readouterr()


@pytest.mark.realtime
def test_the_command_passes_the_simulated_driver(capsys):
    code, out, _ = run_command(capsys, "simulated", "--json", "--response-s", "5")
    outcomes = [json.loads(line) for line in out.splitlines()]
    assert code == 0
    assert [outcome["check"] for outcome in outcomes] == list(CHECKS)
    assert all(outcome["passed"] in {True, None} for outcome in outcomes)


@pytest.mark.realtime
def test_the_command_fails_a_loop_whose_device_is_absent(capsys, tmp_path):
    file = tmp_path / "loops.toml"
    file.write_text(
        '[loops.A]\ndriver = "modbus"\n[loops.A.device]\nhost = "127.0.0.1"\nport = 1\n'
        'registers.pv = {table = "input", address = 0}\nregisters.output = {table = "holding", address = 0}\n',
        encoding="utf-8",
    )
    code, out, _ = run_command(capsys, "modbus", "--config", str(file))
    assert code == 1
    assert "FAILED   reads advance: raised LinkError" in out
    assert "passed   port" in out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("teapot",), "driver: is not an installed driver (got 'teapot')"),
        (("modbus", "--config", "/no/such/file.toml"), "/no/such/file.toml: cannot be used"),
        (("modbus",), "registers: is missing"),
    ],
)
def test_the_command_says_why_it_cannot_run(capsys, arguments, words):
    code, _, err = run_command(capsys, *arguments)
    assert code == 2
    assert words in err
