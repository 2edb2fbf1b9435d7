"""Re-tuning a loop in automatic again and again, each time under the gains of the tuning before.

    python benchmarks/safety/retunings.py --peer PLC.py [--rounds 10] [--noise 0.2] [--seed 1]

The PLC is a program of its own whose Modbus side shares no code with ours (see `release.py`). Its plant has K = 2,
T = 5 s, D = 0.7 s. Its own PID drives the output in automatic when `autotuner tune --apply` begins.

    K, half    static gain with half of its 95 % interval
    inside     whether K = 2 lies in that interval
    gains      Kp, Ti, Td that the device has afterwards: the next tuning begins under them
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

TRUTH = {"K": 2.0, "T": 5.0, "D": 0.7}
CONFIGURATION = """
[service]
data_directory = "{folder}/data"

[loops.TIC-101]
driver = "modbus"
sample_time_s = 0.1
limits = {{ output = [0.0, 100.0], pv = [-100.0, 300.0] }}
relay = {{ amplitude = 10.0 }}

[loops.TIC-101.gains]
form = "ideal"
derivative_filter = 8.0
scan_s = 0.05

[loops.TIC-101.device]
host = "127.0.0.1"
port = {port}

[loops.TIC-101.device.registers]
pv = {{ table = "input", address = 0, type = "int16", scale = 0.1 }}
output = {{ table = "holding", address = 0, type = "int16", scale = 0.1 }}
set_point = {{ table = "holding", address = 1, type = "int16", scale = 0.1 }}
auto = {{ table = "coil", address = 0 }}
kp = {{ table = "holding", address = 10, type = "float32" }}
ti = {{ table = "holding", address = 12, type = "float32" }}
td = {{ table = "holding", address = 14, type = "float32" }}
"""
LONGEST_S = 300.0


def started(peer, noise, seed):
    """Start the PLC, at rest at an output of 40 under its own PID."""
    command = [sys.executable, peer, "--tcp", "0", "--plant", *map(str, TRUTH.values()), "--scan", "0.05"]
    command += ["--noise", str(noise), "--seed", str(seed), "--u0", "40", "--y0", "80", "--ubias", "40", "--sp", "80"]
    command += ["--own-pid", "0.5", "5", "0", "--auto"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)  # noqa: S603
    return process, json.loads(process.stdout.readline())


def tuned(config, folder):
    """Tune and apply once; return the result."""
    command = [sys.executable, "-m", "autotuner", "tune", "TIC-101", "--config", str(config), "--apply", "--json"]
    environment = {**os.environ, "XDG_STATE_HOME": str(folder / "state")}
    done = subprocess.run(  # noqa: S603 - ourselves
        command, capture_output=True, text=True, timeout=LONGEST_S, check=False, env=environment
    )
    sys.stderr.write(done.stderr)
    return json.loads(done.stdout) if done.stdout else None


def row(number, told):
    """Return the row of a tuning, and whether K was inside its interval."""
    estimate = (told or {}).get("estimates", {}).get((told or {}).get("recommended"), {})
    if "K" not in estimate.get("interval95", {}):
        return f"| {number} | - | - | no | {told and told['verdict']['message']} |", False
    (low, high), K = estimate["interval95"]["K"], estimate["model"]["K"]
    inside = low <= TRUTH["K"] <= high
    held = (told.get("applied") or {}).get("now", {}).get("values", {})
    gains = ", ".join(f"{held[name]:.3g}" for name in ("kp", "ti", "td") if name in held)
    return f"| {number} | {K:.3f} | {(high - low) / 2.0:.3f} | {'yes' if inside else 'no'} | {gains} |", inside


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer", required=True, help="the PLC: a Python program")
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--noise", type=float, default=0.2, help="standard deviation of the PV's noise, PV units")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        process, ready = started(args.peer, args.noise, args.seed)
        try:
            config = folder / "loops.toml"
            config.write_text(CONFIGURATION.format(folder=folder, port=ready["tcp"]), encoding="utf-8")
            print("| | K | half | inside | gains |\n|---|---|---|---|---|", flush=True)
            inside = 0
            for number in range(1, args.rounds + 1):
                text, good = row(number, tuned(config, folder))
                inside += good
                print(text, flush=True)
        finally:
            process.kill()
            process.communicate()
    print(f"\nK inside its 95 % interval: {inside} of {args.rounds}")


if __name__ == "__main__":
    main()
