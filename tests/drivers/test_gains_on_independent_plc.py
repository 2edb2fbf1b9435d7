"""What a user is shown is what the device does: predicted overshoot and settling time against a PLC that is not ours.

The PLC runs the ideal form with the set-point weight 1 and no filter. A weight below 1 is made of its own controller by
the prefilter `(1 + b Ti s)/(1 + Ti s)` of the set point, which is the same controller for a step from rest.
"""

import json
import math
import subprocess
import sys
from time import monotonic, sleep  # noqa: TID251 - the PLC runs on the wall clock

import numpy as np
import pytest

from tests.control.processes import PATIENCE_S
from tests.drivers.test_tune_independent_plc import ask

STEP = 5.0
REST = ("--auto", "--u0", 15, "--ubias", 15, "--y0", 50, "--sp", 50, "--own-pid", 0.5, 2.0, 0.0)
PLANT = ("--plant", 2, 2, 0.3, "--noise", 0.03, "--seed", 1, "--scan", 0.01)
REGISTERS = (
    "pv=ir:0:float32,out=hr:0:float32,outrb=ir:2:float32,sp=hr:2:float32,auto=co:0,alarm=di:0,hb=ir:4:uint16,"
    "kp=hr:10:float32,ti=hr:12:float32,td=hr:14:float32"
)
CONFIG = """
[loops.TIC-101]
driver = "modbus"
sample_time_s = 0.04
[loops.TIC-101.limits]
output = [0.0, 100.0]
pv = [0.0, 200.0]
[loops.TIC-101.relay]
amplitude = 10.0
quiet_s = 2.0
[loops.TIC-101.gains]
form = "ideal"
scan_s = 0.01
set_point_weight = {b}
[loops.TIC-101.device]
host = "127.0.0.1"
port = {port}
timeout_s = 0.5
[loops.TIC-101.device.registers]
pv = {{ table = "input", address = 0, type = "float32" }}
output = {{ table = "holding", address = 0, type = "float32" }}
set_point = {{ table = "holding", address = 2, type = "float32" }}
auto = {{ table = "coil", address = 0 }}
kp = {{ table = "holding", address = 10, type = "float32" }}
ti = {{ table = "holding", address = 12, type = "float32" }}
td = {{ table = "holding", address = 14, type = "float32" }}
"""


def followed(plc, b, Ti, seconds):
    """Make a step of the set point, weighted by `b`, and return times and PV as the PLC has them."""
    rows = []
    rest = np.mean([ask(plc["control"])["pv"] for _ in range(40)])
    begun = monotonic()
    while (t := monotonic() - begun) < seconds:
        weighted = STEP * (1.0 - (1.0 - b) * math.exp(-t / Ti))
        ask(plc["control"], f"set sp {50.0 + weighted}")
        rows.append((t, ask(plc["control"])["pv"] - rest))
        sleep(0.01)
    return np.array(rows).T


@pytest.mark.realtime
@pytest.mark.parametrize("b", [1.0, 0.25])
def test_the_device_does_what_table_chart_report_and_api_predict(b, peer, tmp_path):
    plc = peer("plc_libmodbus.py", "--tcp", 0, "--control", 0, *PLANT, *REST, "--registers", REGISTERS)
    config, report = tmp_path / "loops.toml", tmp_path / "report.html"
    config.write_text(CONFIG.format(port=plc["tcp"], b=b), encoding="utf-8")
    verify = ["--verify", str(STEP)] if b == 1.0 else ["--apply"]
    words = ["--structure", "fopdt", "--json", "--report", report, *verify]
    done = subprocess.run(
        [sys.executable, "-m", "autotuner", "tune", "--config", config, *words],
        capture_output=True, text=True, timeout=PATIENCE_S, check=False, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    told = json.loads(done.stdout)
    predicted, held = told["tuning"]["predicted"], told["tuning"]["device"]["gains"]
    assert (held["b"], held["Tf"]) == (b, 0.0)
    assert told["tuning"]["overshoot"] == predicted["overshoot"]
    assert f"{100.0 * predicted['overshoot']:.2g} %" in report.read_text(encoding="utf-8")
    sleep(4.0)
    t, pv = followed(plc, b, held["Ti"], 2.0 * predicted["settling_time_s"] + 1.0)
    smooth = np.convolve(pv, np.full(5, 0.2), "valid")
    assert max(0.0, smooth.max() / STEP - 1.0) == pytest.approx(predicted["overshoot"], abs=0.03)
    outside = np.abs(smooth - STEP) > 0.04 * STEP  # 2 % of the step is 2 sigma of the noise
    assert t[np.flatnonzero(outside)[-1]] < 1.1 * predicted["settling_time_s"] + 0.1
    if b == 1.0:
        assert told["verification"]["passed"]
        assert told["verification"]["predicted_overshoot"] == pytest.approx(predicted["overshoot"], abs=0.01)
