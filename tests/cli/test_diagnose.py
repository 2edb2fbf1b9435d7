"""`autotuner diagnose` on a file, as a user reads it."""

import numpy as np

from autotuner.cli import main


def test_an_effect_is_printed_with_its_form(tmp_path, capsys):
    """A valve of rangeability 30 before a lag of 12 s, by Euler's method."""
    random = np.random.default_rng(4)
    output = np.repeat(random.choice([30.0, 35.0, 45.0, 50.0], 15), 20)
    output[:20] = 40.0
    flow = 100.0 * 30.0 ** (output / 100.0 - 1.0)
    pv, x = [], 0.0
    for valve in flow.tolist():
        pv.append(60.0 + x)
        for _ in range(20):
            x += 0.05 / 12.0 * (6.0 * (valve - flow[0]) - x)
    noisy = np.array(pv) + random.normal(0.0, 0.05, output.size)
    file = tmp_path / "valve.csv"
    rows = np.column_stack((np.arange(output.size), output, noisy))
    np.savetxt(file, rows, delimiter=",", header="t,u,y", comments="")
    assert main(["diagnose", str(file)]) == 0
    assert "static_nonlinearity, equal percentage (actuator)" in capsys.readouterr().out
