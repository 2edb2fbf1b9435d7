"""A tuning over each protocol, against a peer on another library: done, killed and cut in the middle.

    NODE_PATH=FOLDER/node_modules python benchmarks/safety/protocols.py [--only opcua mqtt] [--rounds 3] [--seed 1]

Modbus TCP and RTU: the PLC on libmodbus of ../shared/peers, RTU by a pseudo-terminal that its proxy unplugs. OPC UA: a
PLC on node-opcua (npm install --prefix FOLDER node-opcua). MQTT: a device on paho behind mosquitto. S7: the server of
python-snap7. EPICS: an IOC of EPICS base (pip install softioc). EtherNet/IP: the server of cpppo (pip install cpppo).
Each is a process of its own with the plant K = 2, T = 2 s, D = 0.3 s, its own controller in automatic. A protocol whose
peer is not installed is left out, with the reason. Peers run by SCHED_FIFO where that is allowed, as a PLC does.

    done    `autotuner tune --apply --verify`, then `autotuner rollback`: K, T, D with their errors, and the gains
    kill    the command is killed with -9 at a random moment of the relay; what restores is whatever is left, and
            after 20 s the next command on this loop
    cut     the connection is cut for 4 s at a random moment of the relay
    back    seconds until output, mode and gains are as they were found, read from the device past the cut
"""

import argparse
import asyncio
import contextlib
import importlib.util
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import ClassVar

from autotuner.errors import AutotunerError

ROOT = Path(__file__).parents[2]
PEERS = ROOT / "tests" / "drivers" / "peers"
SHARED = ROOT.parent / "shared" / "peers"
REAL_TIME = ("chrt", "--fifo", "20") if os.geteuid() == 0 and shutil.which("chrt") else ()
TRUTH = {"K": 2.0, "T": 2.0, "D": 0.3}
LOOP = "bench"
COMMON = """
[loops.bench]
driver = "{driver}"
sample_time_s = 0.1
limits = {{ output = [0.0, 100.0], pv = [-50.0, 250.0] }}
relay = {{ amplitude = 10.0, quiet_s = 3.0 }}
"""
LONGEST_S = 400.0
NOISE = "0.03"
"""Standard deviation of the measured PV; node-opcua and MQTT peers have 0.01 of their own."""
CUT_S = 4.0


class Wire:
    """A TCP forwarder that can be cut."""

    def __init__(self, target):
        self._target, self._writers, self.cut = target, set(), False

    async def start(self):
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        return self._server.sockets[0].getsockname()[1]

    async def _serve(self, reader, writer):
        if self.cut:
            writer.transport.abort()
            return
        far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._target)
        self._writers |= {writer, far_writer}
        await asyncio.gather(_pump(reader, far_writer), _pump(far_reader, writer))

    async def interrupt(self, seconds):
        self.cut = True
        for writer in self._writers:
            writer.transport.abort()
        self._writers.clear()
        await asyncio.sleep(seconds)
        self.cut = False


async def _pump(reader, writer):
    with contextlib.suppress(OSError):
        while data := await reader.read(65536):
            writer.write(data)
            await writer.drain()
    writer.close()


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def started(stack, command, ready="{", **options):
    words, options = [*REAL_TIME, *map(str, command)], {"env": dict(os.environ)} | options
    options["env"]["PEER_NOISE"] = NOISE
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, **options)  # noqa: S603
    stack.callback(process.wait)
    stack.callback(process.kill)
    for line in process.stdout:
        if line.startswith(ready):
            return json.loads(line)
    raise RuntimeError(f"{command[1]} did not start")


class OpcUa:
    """A PLC on node-opcua."""

    found: ClassVar = {"output": 40.0, "auto": 1.0, "kp": 1.0, "ti": 5.0, "td": 0.0}
    gains = '[loops.bench.gains]\nform = "ideal"\nscan_s = 0.02\n'
    wishes = ()

    def __init__(self, stack, folder):
        node = shutil.which("node")
        resolve = [node, "-e", "require.resolve('node-opcua')"]
        if node is None or subprocess.run(resolve, check=False, capture_output=True).returncode:  # noqa: S603
            raise LookupError("node-opcua is not installed")
        self.port = free_port()
        words = [node, str(PEERS / "opcua_plc.js"), str(self.port), *map(str, TRUTH.values())]
        self._ns = started(
            stack, words, stderr=subprocess.DEVNULL, env={**os.environ, "PKI_FOLDER": str(folder / "pki")}
        )["namespace"]

    def device(self, port):
        names = {"pv": "PV", "output": "OUT", "set_point": "SP", "auto": "MODE", "kp": "KP", "ti": "TI", "td": "TD"}
        nodes = {name: {"node": f"ns={self._ns};s={node}"} for name, node in names.items()}
        return {"endpoint": f"opc.tcp://127.0.0.1:{port}/plc", "timeout_s": 2.0, "nodes": nodes}


class Mqtt:
    """A device on paho behind mosquitto."""

    found: ClassVar = {"output": 40.0, "auto": 1.0, "kp": 1.0, "ti": 5.0}
    gains = '[loops.bench.gains]\nform = "ideal"\nderivative = ""\nscan_s = 0.01\n'
    wishes = ("--controller", "PI")

    def __init__(self, stack, folder):
        mosquitto = shutil.which("mosquitto", path="/usr/sbin:/usr/bin:/usr/local/sbin")
        if not mosquitto or importlib.util.find_spec("aiomqtt") is None:
            raise LookupError("mosquitto or aiomqtt is not installed")
        self.port = free_port()
        file = folder / "mosquitto.conf"
        file.write_text(f"listener {self.port} 127.0.0.1\nallow_anonymous true\n", encoding="utf-8")
        broker = subprocess.Popen([mosquitto, "-c", str(file)], stderr=subprocess.DEVNULL)  # noqa: S603
        stack.callback(broker.wait)
        stack.callback(broker.kill)
        time.sleep(1.0)
        words = [sys.executable, str(PEERS / "mqtt_device.py"), str(self.port), *map(str, TRUTH.values())]
        started(stack, words)

    def device(self, port):
        topics = {
            "pv": {"topic": "dev/sensor", "json": "DS18B20.Temperature"},
            "output": {"topic": "dev/out", "json": "out", "command": "dev/out/set", "payload": "{value:.2f}"},
            "auto": {"topic": "dev/mode", "command": "dev/mode/set", "auto_value": "auto", "manual_value": "off"},
            "set_point": {"topic": "dev/sp", "command": "dev/sp/set"},
            "kp": {"topic": "dev/kp", "command": "dev/kp/set"},
            "ti": {"topic": "dev/ti", "command": "dev/ti/set"},
        }
        return {"host": "127.0.0.1", "port": port, "interval_s": 1.0, "timeout_s": 2.0, "topics": topics}


class S7:
    """The server of python-snap7."""

    found: ClassVar = {"output": 40.0, "auto": 1.0, "kp": 1.0, "ti": 5.0}
    gains = '[loops.bench.gains]\nform = "ideal"\nderivative = ""\nscan_s = 0.01\n'
    wishes = ("--controller", "PI")

    def __init__(self, stack, _folder):
        if importlib.util.find_spec("snap7") is None:
            raise LookupError("python-snap7 is not installed")
        self.port = free_port()
        words = [sys.executable, str(PEERS / "s7_plc.py"), str(self.port), *map(str, TRUTH.values())]
        started(stack, words)

    def device(self, port):
        places = {name: {"db": 10, "byte": 4 * k} for k, name in enumerate(("pv", "output", "set_point", "kp", "ti"))}
        variables = places | {"auto": {"db": 10, "byte": 20, "bit": 0}}
        return {"host": "127.0.0.1", "port": port, "timeout_s": 2.0, "variables": variables}


class Epics:
    """An IOC of EPICS base."""

    found: ClassVar = {"output": 40.0, "auto": 1.0, "kp": 1.0, "ti": 5.0}
    gains = '[loops.bench.gains]\nform = "ideal"\nderivative = ""\nscan_s = 0.01\n'
    wishes = ("--controller", "PI")

    def __init__(self, stack, _folder):
        if any(importlib.util.find_spec(name) is None for name in ("caproto", "softioc")):
            raise LookupError("caproto or softioc is not installed")
        self.port = free_port()
        words = [sys.executable, PEERS / "epics_ioc.py", self.port, *TRUTH.values()]
        started(stack, words, stderr=subprocess.DEVNULL)

    def device(self, port):
        names = {"pv": "PV", "output": "OUT", "set_point": "SP", "kp": "KP", "ti": "TI", "auto": "MODE"}
        channels = {name: {"name": f"TIC:{record}"} for name, record in names.items()}
        return {"host": "127.0.0.1", "port": port, "search": False, "timeout_s": 2.0, "channels": channels}


class EtherNetIp:
    """The server of cpppo."""

    found, gains, wishes = Epics.found, Epics.gains, Epics.wishes

    def __init__(self, stack, _folder):
        if any(importlib.util.find_spec(name) is None for name in ("pylogix", "cpppo")):
            raise LookupError("pylogix or cpppo is not installed")
        self.port = free_port()
        started(stack, [sys.executable, PEERS / "ethernetip_plc.py", self.port, *TRUTH.values()])

    def device(self, port):
        names = {"pv": "PV", "output": "OUT", "set_point": "SP", "kp": "KP", "ti": "TI", "auto": "MODE"}
        tags = {name: {"tag": tag} for name, tag in names.items()}
        return {"host": "127.0.0.1", "port": port, "timeout_s": 2.0, "tags": tags}


class Modbus:
    """The PLC on libmodbus, by TCP."""

    found: ClassVar = {"output": 40.0, "auto": 1.0, "kp": 1.0, "ti": 5.0, "td": 0.0}
    gains = '[loops.bench.gains]\nform = "ideal"\nscan_s = 0.01\n'
    wishes = ()
    line: ClassVar = ("--tcp", "0")
    registers = (
        "pv=ir:0:float32,out=hr:0:float32,sp=hr:2:float32,auto=co:0,kp=hr:10:float32,ti=hr:12:float32,td=hr:14:float32"
    )
    rest: ClassVar = (
        "--auto", "--u0", "40", "--ubias", "40", "--y0", "80", "--sp", "80",
        "--own-pid", "1", "5", "0", "--scan", "0.01", "--noise", "0.03", "--seed", "1",
    )  # fmt: skip

    def __init__(self, stack, folder):
        if not (SHARED / "plc_libmodbus.py").exists():
            raise LookupError("../shared/peers is not there")
        words = [sys.executable, SHARED / "plc_libmodbus.py", *self.line, "--control", "0", "--plant", *TRUTH.values()]
        self.ready = started(stack, [*words, *self.rest, "--registers", self.registers], cwd=folder)
        self.port = self.ready.get("tcp")

    def device(self, port):
        holding = {"output": 0, "set_point": 2, "kp": 10, "ti": 12, "td": 14}
        registers = {name: {"table": "holding", "address": at, "type": "float32"} for name, at in holding.items()}
        registers |= {
            "pv": {"table": "input", "address": 0, "type": "float32"},
            "auto": {"table": "coil", "address": 0},
        }
        return {"host": "127.0.0.1", "port": port, "timeout_s": 0.5, "registers": registers}


class ModbusRtu(Modbus):
    """The PLC on libmodbus, by RTU through a line that can be unplugged; its control port shows what it holds."""

    line: ClassVar = ("--rtu-link", "ttyPLC")
    driver = "modbus"

    def __init__(self, stack, folder):
        super().__init__(stack, folder)
        self._far = folder / "ttyBENCH"
        words = [sys.executable, SHARED / "chaos_proxy.py", "--link", self._far, "--device", folder / "ttyPLC"]
        self._proxy = started(stack, [*words, "--control", "0"], cwd=folder)["control"]

    def wire(self):
        return self

    def judge(self):
        return self

    def device(self, _port):
        device = super().device(0)
        line = {"transport": "rtu", "serial_port": str(self._far), "parity": "N"}
        return line | {"timeout_s": 0.3, "registers": device["registers"]}

    async def start(self):
        return 0

    async def interrupt(self, seconds):
        await said(self._proxy, f"on unplug {seconds}")
        await asyncio.sleep(seconds)

    async def open(self):
        pass

    async def close(self):
        pass

    async def write(self, values):
        pass

    async def read(self, names):
        held = json.loads(await said(self.ready["control"], "get"))
        return {name: float(held["u_cmd" if name == "output" else name]) for name in names}


async def said(port, line):
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(f"{line}\n".encode())
    answer = await reader.readline()
    writer.close()
    return answer.decode()


PROTOCOLS = {
    "modbus": Modbus,
    "rtu": ModbusRtu,
    "opcua": OpcUa,
    "mqtt": Mqtt,
    "s7": S7,
    "epics": Epics,
    "ethernetip": EtherNetIp,
}


def as_toml(value):
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {as_toml(item)}" for key, item in value.items()) + " }"
    return json.dumps(value)


class Bench:
    """One protocol: its peer, the wire in front of it, the command, and the judge that reads the device itself."""

    def __init__(self, name, peer, folder):
        self.name, self.peer, self.folder = name, peer, folder
        self.file = folder / "loops.toml"
        self.environment = {
            **os.environ,
            "XDG_DATA_HOME": str(folder / "data"),
            "XDG_STATE_HOME": str(folder / "state"),
        }

    async def prepare(self):
        driver = getattr(self.peer, "driver", self.name)
        self.wire = self.peer.wire() if hasattr(self.peer, "wire") else Wire(self.peer.port)
        device = self.peer.device(await self.wire.start())
        lines = "\n".join(f"{key} = {as_toml(value)}" for key, value in device.items())
        self.file.write_text(
            f"{COMMON.format(driver=driver)}\n{self.peer.gains}\n[loops.bench.device]\n{lines}\n", encoding="utf-8"
        )
        factory = importlib.import_module(f"autotuner_drivers.{driver}").create
        self.judge = self.peer.judge() if hasattr(self.peer, "judge") else factory(self.peer.device(self.peer.port))
        await self.judge.open()
        await self.judge.write({"auto": 0.0})
        await self.judge.write({name: value for name, value in self.peer.found.items() if name != "auto"})
        await self.judge.write({"auto": 1.0})
        await asyncio.sleep(2.0)

    async def command(self, *words):
        return await asyncio.create_subprocess_exec(
            sys.executable, "-m", "autotuner", *words, "--config", str(self.file),
            stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE, cwd=self.folder, env=self.environment,
        )  # fmt: skip

    async def finished(self, *words):
        process = await self.command(*words)
        async with asyncio.timeout(LONGEST_S):
            out, err = await process.communicate()
        return process.returncode, out.decode(), err.decode()

    async def read(self):
        async with asyncio.timeout(20.0):
            while True:
                with contextlib.suppress(AutotunerError):
                    return await self.judge.read(sorted(self.peer.found))
                await asyncio.sleep(0.1)

    async def until(self, holds, limit_s):
        """Return the seconds until the device is so; None after the limit."""
        begun = time.monotonic()
        while time.monotonic() < begun + limit_s:
            with contextlib.suppress(AutotunerError):
                if holds(await self.read()):
                    return time.monotonic() - begun
            await asyncio.sleep(0.1)
        return None

    def as_found(self, values):
        # in automatic the device's own controller moves the output about the one that was found
        close = {
            name: abs(values[name] - value) < (3.0 if name == "output" else 1e-3)
            for name, value in self.peer.found.items()
        }
        return all(close.values())

    async def in_relay(self, rng):
        seconds = await self.until(lambda values: values["auto"] == 0.0 and abs(values["output"] - 40.0) > 5.0, 60.0)
        await asyncio.sleep(rng.uniform(0.0, 3.0))
        return seconds is not None

    async def done(self):
        code, out, err = await self.finished("tune", LOOP, *self.peer.wishes, "--apply", "--verify", "--json")
        if not out:
            return f"NOT tuned: {err.strip()[-200:]}"
        result = json.loads(out)
        model, verified = result["model"] or {}, (result.get("verification") or {}).get("verdict") or {}
        errors = ", ".join(f"{k} {100 * (model[k] / TRUTH[k] - 1):+.1f} %" for k in TRUTH if k in model)
        now = await self.read()
        changed = any(abs(now[name] - self.peer.found[name]) > 1e-3 for name in ("kp", "ti"))
        code, _, err = await self.finished("rollback", LOOP)
        back = await self.until(self.as_found, 20.0)
        said = f"{result['verdict']['code']}, {verified.get('code')} ({verified.get('message')})"
        return (
            f"{errors}; {said}; in the device: {'yes' if changed else 'no'}; rollback {code}, back {back is not None}"
        )

    async def kill(self, rng):
        process = await self.command("tune", LOOP, *self.peer.wishes, "--json")
        if not await self.in_relay(rng):
            return "no relay seen"
        begun = time.monotonic()
        process.send_signal(signal.SIGKILL)
        await process.wait()
        if await self.until(self.as_found, 20.0) is None:
            await self.finished("rollback", LOOP)
            if await self.until(self.as_found, 20.0) is None:
                return f"NOT restored: {await self.read()}"
            return f"restored by the next start, {time.monotonic() - begun:.1f} s"
        return f"restored in {time.monotonic() - begun:.1f} s"

    async def cut(self, rng):
        process = await self.command("tune", LOOP, *self.peer.wishes, "--json")
        if not await self.in_relay(rng):
            return "no relay seen"
        await self.wire.interrupt(CUT_S)
        back = await self.until(self.as_found, 60.0)
        out, _ = await process.communicate()
        text = f"code {process.returncode}"
        with contextlib.suppress(ValueError, KeyError, TypeError):
            text = str(json.loads(out)["verdict"]["code"])
        return f"{'NOT restored' if back is None else f'restored {back:.1f} s after the link'} ({text})"


async def measure(name, peer, folder, args, rng):
    bench = Bench(name, peer, folder)
    await bench.prepare()
    print(f"{name:10} done  {await bench.done()}", flush=True)
    for _ in range(args.rounds):
        for kind in ("kill", "cut"):
            print(f"{name:10} {kind:5} {await getattr(bench, kind)(rng)}", flush=True)
    await bench.judge.close()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=PROTOCOLS, default=list(PROTOCOLS))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    for name in args.only:
        with contextlib.ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
            try:
                peer = PROTOCOLS[name](stack, Path(folder))
            except LookupError as reason:
                print(f"{name:10} left out: {reason}")
                continue
            asyncio.run(measure(name, peer, Path(folder), args, random.Random(args.seed)))  # noqa: S311


if __name__ == "__main__":
    main()
