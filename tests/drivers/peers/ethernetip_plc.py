"""A controller on the EtherNet/IP server of cpppo: a plant under a PI controller.

python ethernetip_plc.py PORT K T D; prints a line of JSON once it listens. Tags: PV, OUT, SP, KP, TI (REAL), MODE (DINT),
COUNT (INT), WORD (DINT).
"""
# ruff: noqa: TID251, E501

import json
import logging
import math
import os
import random
import socket
import sys
import threading
import time

from cpppo.server.enip import device
from cpppo.server.enip import main as enip

SCAN_S = 0.01
NOISE = float(os.environ.get("PEER_NOISE", "0"))
"""Standard deviation of the measured PV."""
HELD = {}


class Tag(device.Attribute):
    """A tag whose value is that of the dictionary."""

    def __getitem__(self, key):
        return HELD[self.name][key] if isinstance(key, slice) else HELD[self.name]

    def __setitem__(self, key, value):
        HELD[self.name] = value if isinstance(key, slice) else [value]


def controller(K, T, D):
    line, pv, integral, begun, scans = [40.0] * round(D / SCAN_S), 40.0 * K, 40.0, time.monotonic(), 0
    while True:
        time.sleep(SCAN_S)
        while begun + scans * SCAN_S < time.monotonic():
            scans += 1
            out, sp, kp, ti = (HELD[name][0] for name in ("OUT", "SP", "KP", "TI"))
            if HELD["MODE"][0]:
                integral = min(max(integral + kp / ti * (sp - pv) * SCAN_S, 0.0), 100.0)
                out = min(max(kp * (sp - pv) + integral, 0.0), 100.0)
                HELD["OUT"] = [out]
            else:
                integral = out - kp * (sp - pv)
            line.append(out)
            target = K * line.pop(0)
            pv = target + (pv - target) * math.exp(-SCAN_S / T)
            HELD["PV"] = [pv + random.gauss(0.0, NOISE)]


def announce(port):
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), 1.0).close()
        except OSError:
            time.sleep(0.1)
        else:
            print(json.dumps({"port": port}), flush=True)
            return


def run():
    logging.disable(logging.CRITICAL)
    port, (K, T, D) = int(sys.argv[1]), map(float, sys.argv[2:5])
    reals = {"PV": 40.0 * K, "OUT": 40.0, "SP": 40.0 * K, "KP": 1.0, "TI": 5.0}
    integers = {"MODE": ("DINT", 1), "COUNT": ("INT", 7), "WORD": ("DINT", 5)}
    HELD.update({name: [value] for name, value in reals.items()} | {name: [v] for name, (_, v) in integers.items()})
    words = [f"{name}=REAL" for name in reals] + [f"{name}={kind}" for name, (kind, _) in integers.items()]
    for job in (lambda: controller(K, T, D), lambda: announce(port)):
        threading.Thread(target=job, daemon=True).start()
    enip.main(["--no-udp", "--address", f"127.0.0.1:{port}", *words], attribute_class=Tag)


if __name__ == "__main__":
    run()
