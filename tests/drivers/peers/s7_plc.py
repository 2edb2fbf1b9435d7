"""A PLC on the server of python-snap7: a plant under a PI controller, in data block 10.

python s7_plc.py PORT K T D; prints a line of JSON once it listens. DB10: 0 pv, 4 output, 8 set point, 12 kp, 16 ti (real), 20.0 auto.
"""
# ruff: noqa: TID251, E501

import json
import logging
import math
import os
import random
import struct
import sys
import time

from snap7.server import Server
from snap7.type import SrvArea

SCAN_S = 0.01
NOISE = float(os.environ.get("PEER_NOISE", "0"))
"""Standard deviation of the measured PV."""


def main():
    logging.disable(logging.CRITICAL)
    port, (K, T, D) = int(sys.argv[1]), map(float, sys.argv[2:5])
    block = bytearray(64)
    struct.pack_into(">fffff", block, 0, 40.0 * K, 40.0, 40.0 * K, 1.0, 5.0)
    server = Server()
    server.register_area(SrvArea.DB, 10, block)
    server.start(port)
    print(json.dumps({"port": port}), flush=True)
    line, pv, integral, begun, scans = [40.0] * round(D / SCAN_S), 40.0 * K, 40.0, time.monotonic(), 0
    while True:
        time.sleep(SCAN_S)
        while begun + scans * SCAN_S < time.monotonic():
            scans += 1
            _, out, sp, kp, ti = struct.unpack_from(">fffff", block, 0)
            if block[20] & 1:
                integral = min(max(integral + kp / ti * (sp - pv) * SCAN_S, 0.0), 100.0)
                out = min(max(kp * (sp - pv) + integral, 0.0), 100.0)
                struct.pack_into(">f", block, 4, out)
            else:
                integral = out - kp * (sp - pv)
            line.append(out)
            target = K * line.pop(0)
            pv = target + (pv - target) * math.exp(-SCAN_S / T)
            struct.pack_into(">f", block, 0, pv + random.gauss(0.0, NOISE))


if __name__ == "__main__":
    main()
