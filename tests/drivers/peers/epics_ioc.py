"""An IOC of EPICS base (softioc): a plant under a PI controller.

python epics_ioc.py PORT K T D [stale|invalid]; prints a line of JSON once it listens on UDP and TCP PORT.
Records: PV (ai), OUT, SP, KP, TI (ao), MODE (bo: Manual, Auto), STATE (mbbi of three), COUNT (longout), NOTE (stringout).
`stale` processes PV no more after the start, `invalid` raises the severity of PV to INVALID.
"""
# ruff: noqa: TID251, E402, E501

import os
import sys

PORT, (K, T, D), *WORDS = sys.argv[1], map(float, sys.argv[2:5]), *sys.argv[5:]
os.environ |= {
    "EPICS_CA_SERVER_PORT": PORT,
    "EPICS_CAS_SERVER_PORT": PORT,
    "EPICS_CAS_INTF_ADDR_LIST": "127.0.0.1",
    "EPICS_CAS_BEACON_ADDR_LIST": "127.0.0.1",
    "EPICS_CAS_AUTO_BEACON_ADDR_LIST": "NO",
    "EPICS_CA_AUTO_ADDR_LIST": "NO",
}

import json
import math
import random
import time

from softioc import alarm, asyncio_dispatcher, builder, softioc

SCAN_S = 0.01
NOISE = float(os.environ.get("PEER_NOISE", "0"))
"""Standard deviation of the measured PV."""
PREFIX = "TIC"


def main():
    builder.SetDeviceName(PREFIX)
    pv_record = builder.aIn("PV", initial_value=40.0 * K, EGU="degC", PREC=3)
    records = {
        name: builder.aOut(name, initial_value=value, always_update=True, **fields)
        for name, value, fields in (
            ("OUT", 40.0, {"DRVL": 0, "DRVH": 100, "LOPR": 0, "HOPR": 100, "EGU": "%"}),
            ("SP", 40.0 * K, {"EGU": "degC"}),
            ("KP", 1.0, {}),
            ("TI", 5.0, {}),
        )
    }
    mode = builder.boolOut("MODE", "Manual", "Auto", initial_value=1)
    builder.mbbIn("STATE", "Off", "Local", "Remote", initial_value=2)
    builder.longOut("COUNT", initial_value=7)
    builder.stringOut("NOTE", initial_value="none")
    dispatcher = asyncio_dispatcher.AsyncioDispatcher()
    builder.LoadDatabase()
    softioc.iocInit(dispatcher)
    print(json.dumps({"port": int(PORT)}), flush=True)
    line, pv, integral, begun, scans = [40.0] * round(D / SCAN_S), 40.0 * K, 40.0, time.monotonic(), 0
    if "invalid" in WORDS:
        pv_record.set(pv, severity=alarm.INVALID_ALARM, alarm=alarm.READ_ALARM)
    while True:
        time.sleep(SCAN_S)
        out = records["OUT"].get()
        while begun + scans * SCAN_S < time.monotonic():
            scans += 1
            sp, kp, ti = (records[name].get() for name in ("SP", "KP", "TI"))
            if mode.get():
                integral = min(max(integral + kp / ti * (sp - pv) * SCAN_S, 0.0), 100.0)
                out = min(max(kp * (sp - pv) + integral, 0.0), 100.0)
            else:
                integral = out - kp * (sp - pv)
            line.append(out)
            target = K * line.pop(0)
            pv = target + (pv - target) * math.exp(-SCAN_S / T)
        if mode.get():
            records["OUT"].set(out)
        if not WORDS:
            pv_record.set(pv + random.gauss(0.0, NOISE))


if __name__ == "__main__":
    main()
