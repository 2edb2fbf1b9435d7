"""Tunings of a PLC that is not ours, in the shapes of real PLCs and over bad lines: what becomes of the loop.

Each row is one run of `autotuner tune` against the libmodbus PLC of the shared peers, with or without their chaos proxy
in between. The PLC's own log says what its output really did.

    outcome    the verdict of the tuning; `done` with the errors of the model
    gain       error of the proportional gain of a SIMC PI controller for the model found, against that for the plant
    output     lowest and highest output that the plant got
    back       whether output and mode are as they were found
    safe       real seconds from the start of the fault, or of the tuning where there is none, until the output is back
    slip       seconds by which the PLC's plant fell behind the clock during the run: on a busy machine its own program
               comes late, and a row with more than a few tenths tells nothing about the tuner

    python benchmarks/safety/bad_links.py [--keep FOLDER] [word of a row ...]

With `--keep` the result and the PLC's log of each row stay in the folder. Started by root, the PLC and the proxy run
with real-time priority, as a PLC does: on a busy machine the plant would otherwise fall behind.
"""

import argparse
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

PEERS = Path(__file__).parents[3] / "shared" / "peers"
PLANT = (2.0, 10.0, 1.5)
LIMITS = (0.0, 100.0)
U0, MODE = 30.0, 0

MAP = {
    "pv": {"table": "input", "address": 0, "scale": 0.1},
    "output": {"table": "holding", "address": 0, "scale": 0.1},
    "auto": {"table": "coil", "address": 0},
}
FLOATS = {
    "pv": {"table": "input", "address": 100, "type": "float32"},
    "output": {"table": "holding", "address": 200, "type": "float32"},
    "auto": {"table": "coil", "address": 0},
}
RTU = {"transport": "rtu", "baudrate": 9600, "parity": "E", "unit": 7}


@dataclass
class Row:
    """One tuning: the PLC's arguments, the chaos rules, the driver's options, and how fast the plant runs."""

    plc: tuple = ()
    chaos: tuple = ()
    device: dict = field(default_factory=dict)
    speed: float = 2.0
    sample_s: float = 0.1
    rtu: bool = False
    auto: bool = False
    fault_at_s: float | None = None
    safety: dict = field(default_factory=dict)


IGNORED = shutil.ignore_patterns("tty*")
REAL_TIME = ("chrt", "--fifo", "20") if os.name == "posix" and os.geteuid() == 0 and shutil.which("chrt") else ()

SLOW: dict[str, Any] = {"speed": 1.0, "sample_s": 0.2}

ROWS = {
    "TCP, float32 low word first": Row(
        ("--registers", "pv=ir:100:float32,out=hr:200:float32,auto=co:0", "--word-order", "little"),
        device={"word_order": "little", "registers": FLOATS},
    ),
    "TCP, int16 x10, no FC 6 and 23": Row(("--deny-fc", "6,23"), device={"use_fc6": False}),
    "TCP, one client only": Row(("--max-clients", 1)),
    "TCP, 10 registers a read": Row(("--max-read", 10), device={"max_registers_per_read": 10}),
    "TCP, own PID in auto": Row(auto=True),
    "RTU, 9600 8E1": Row(rtu=True),
    "RTU, own PID in auto": Row(rtu=True, auto=True),
    "TCP, latency 0.2 s and jitter": Row(
        chaos=("latency=0.2,0.05",), device={"timeout_s": 2.0}, speed=1.0, sample_s=0.5
    ),
    "TCP, split packets": Row(chaos=("split=3,0.005",)),
    "TCP, duplicated packets": Row(chaos=("dup=0.2",)),
    "TCP, reset": Row(chaos=("reset@25+1",), fault_at_s=25.0),
    "TCP, reset, waited for": Row(chaos=("reset@25+1",), fault_at_s=25.0, safety={"device_gone": "wait"}),
    "TCP, blackhole 5 s": Row(chaos=("blackhole@25+5",), device={"timeout_s": 0.5}, fault_at_s=25.0),
    "TCP, one-way silence 5 s": Row(chaos=("down@25+5",), device={"timeout_s": 0.5}, fault_at_s=25.0),
    "TCP, port closed 5 s": Row(chaos=("refuse@25+5",), fault_at_s=25.0),
    "RTU, 2 % corrupted bytes": Row(chaos=("corrupt=0.02",), rtu=True, device={"timeout_s": 0.1, "retries": 4}, **SLOW),
    "RTU, 2 % corrupted, T = 40 s": Row(
        chaos=("corrupt=0.02",),
        rtu=True,
        device={"timeout_s": 0.1, "retries": 8},
        speed=0.25,
        sample_s=1.5,
        safety={"pv_timeout_s": 12.0},
    ),
    "RTU, 0.2 % corrupted bytes": Row(
        chaos=("corrupt=0.002",), rtu=True, device={"timeout_s": 0.1, "retries": 4}, **SLOW
    ),
    "RTU, unplugged for 1 s": Row(chaos=("unplug@25+1",), rtu=True, fault_at_s=25.0),
    "RTU, unplugged for 8 s": Row(chaos=("unplug@25+8",), rtu=True, fault_at_s=25.0),
    "RTU, echo": Row(chaos=("echo",), rtu=True, device={"echo": True}),
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*", help="rows whose name has one of these in it")
    parser.add_argument("--keep", type=Path, help="where results and logs stay")
    args = parser.parse_args()
    names = [name for name in ROWS if not args.words or any(word in name for word in args.words)]
    errors = " ".join(f"{name:>6s}" for name in ("K", "T", "D", "gain"))
    print(f"{'row':34s} {'outcome':22s} {errors}  {'output':>13s}  back   safe   slip  run")
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            print(f"{name:34s} {one(ROWS[name], Path(folder))}", flush=True)
            if args.keep:
                shutil.copytree(folder, args.keep / name.replace(" ", "_"), dirs_exist_ok=True, ignore=IGNORED)


def one(row, folder):
    log = folder / "truth.csv"
    with Peers(row, folder, log) as (device, control):
        before, started = ask(control), time.monotonic()
        done = tune(row, folder, device)
        took_s = time.monotonic() - started
        time.sleep(0.3)
        after = ask(control)
        slip_s = time.monotonic() - started - (after["t"] - before["t"]) / row.speed
    result = json.loads(done.stdout) if done.stdout.strip() else {}
    back = after["auto"] == before["auto"] and (row.auto or abs(after["u_cmd"] - before["u_cmd"]) < 0.06)
    return describe(row, result, back, read_log(log), f"{slip_s:6.2f} {took_s:4.0f}")


def describe(row, result, back, truth, clocks):
    model = (result.get("model") or {}) if (result.get("verdict") or {}).get("outcome") == "done" else {}
    errors = ["", "", ""]
    gain = ""
    if {"K", "T", "D"} <= model.keys():
        K, T, D = PLANT[0], PLANT[1] / row.speed, PLANT[2] / row.speed
        errors = [f"{100.0 * (model[p] / true - 1.0):+.1f}%" for p, true in zip("KTD", (K, T, D), strict=True)]
        ratio = (model["T"] / (model["K"] * model["D"])) / (T / (K * D))
        gain = f"{100.0 * (ratio - 1.0):+.1f}%"
    verdict = result.get("verdict") or {}
    outcome = verdict.get("code") or verdict.get("outcome", "no result")
    low, high = min(u for _, u in truth), max(u for _, u in truth)
    away = [t for t, u in truth if abs(u - U0) > 0.3]
    safe = (away[-1] / row.speed if away else 0.0) - (row.fault_at_s or 0.0)
    numbers = f"{errors[0]:>6s} {errors[1]:>6s} {errors[2]:>6s} {gain:>6s}"
    safe_s = "  auto" if row.auto else f"{safe:6.1f}"
    return f"{outcome:22s} {numbers}  {low:5.1f}..{high:5.1f}  {'yes' if back else 'NO':4s} {safe_s} {clocks}"


class Peers:
    """The PLC, and the proxy if there is chaos, for as long as the context is open."""

    def __init__(self, row, folder, log):
        K, T, D = PLANT
        wire = (
            ("--rtu-link", folder / "ttyPLC", "--unit", 7, "--baud", 9600, "--parity", "E") if row.rtu else ("--tcp", 0)
        )
        mode = (
            ("--auto", "--ubias", U0, "--y0", 50, "--sp", 50, "--own-pid", 0.5, 1.0 * 10 / row.speed, 0)
            if row.auto
            else ()
        )
        self.plc = [
            "plc_libmodbus.py", *wire, "--control", 0, "--plant", K, T, D, "--noise", 0.05, "--seed", 1, "--scan", 0.01,
            "--speed", row.speed, "--u0", U0, "--log", log, *mode, *row.plc,
        ]  # fmt: skip
        self.row, self.folder, self.running = row, folder, []

    def __enter__(self):
        ready = self.start(*self.plc)
        device = (
            {"serial_port": str(self.folder / "ttyPLC")}
            if self.row.rtu
            else {"host": "127.0.0.1", "port": ready.get("tcp")}
        )
        if self.row.chaos:
            rules = [word for rule in self.row.chaos for word in ("--chaos", rule)]
            if self.row.rtu:
                self.start(
                    "chaos_proxy.py",
                    "--link",
                    self.folder / "ttyBAD",
                    "--device",
                    self.folder / "ttyPLC",
                    "--seed",
                    1,
                    *rules,
                )
                device = {"serial_port": str(self.folder / "ttyBAD")}
            else:
                bad = self.start("chaos_proxy.py", "--listen", 0, "--to", device["port"], "--seed", 1, *rules)
                device = {"host": "127.0.0.1", "port": bad["tcp"]}
        return device, ready["control"]

    def start(self, script, *arguments):
        command = [*REAL_TIME, sys.executable, PEERS / script, *arguments]
        process = subprocess.Popen([str(word) for word in command], stdout=subprocess.PIPE, text=True)  # noqa: S603 - our own
        self.running.append(process)
        return json.loads(process.stdout.readline())

    def __exit__(self, *error):
        for process in reversed(self.running):
            process.terminate()
            process.wait()
            process.stdout.close()


def tune(row, folder, device):
    options = {"timeout_s": 0.3, "registers": MAP} | (RTU if row.rtu else {}) | row.device | device
    config = folder / "loops.toml"
    loop = {
        "driver": "modbus",
        "sample_time_s": row.sample_s,
        "limits": {"output": list(LIMITS), "pv": [-100.0, 300.0]},
        "relay": {"amplitude": 10.0},
        "safety": row.safety,
        "device": options,
    }
    config.write_text(f"loops.X = {toml(loop)}\n", encoding="utf-8")
    recording = str(folder / "recording.csv")
    command = [sys.executable, "-m", "autotuner", "tune", "--config", str(config), "--json", "--recording", recording]
    done = subprocess.run(  # noqa: S603 - our own command
        command, capture_output=True, text=True, timeout=900.0, check=False, cwd=folder
    )
    (folder / "result.json").write_text(done.stdout or done.stderr, encoding="utf-8")
    return done


def toml(value):
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {toml(item)}" for key, item in value.items()) + " }"
    return json.dumps(value)


def ask(port, command="get"):
    with socket.create_connection(("127.0.0.1", port), 5.0) as line:
        line.sendall(command.encode() + b"\n")
        return json.loads(line.makefile().readline())


def read_log(file):
    """Return time (plant seconds) and the output that the plant got."""
    rows = [line.split(",") for line in file.read_text(encoding="utf-8").splitlines()[1:]]
    return [(float(r[0]), float(r[2])) for r in rows if len(r) >= 3 and r[2]]


if __name__ == "__main__":
    main()
