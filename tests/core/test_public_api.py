"""The public names of the package: all there, and free until they are used."""

import subprocess
import sys

import numpy as np
import pytest

import autotuner
from autotuner_sim import Fopdt, Noise, SteppedPlant


def test_every_public_name_exists():
    assert all(getattr(autotuner, name) is not None for name in autotuner.__all__)
    assert set(autotuner.__all__) <= set(dir(autotuner))
    with pytest.raises(AttributeError, match="no attribute 'teleport'"):
        _ = autotuner.teleport


def test_importing_the_package_loads_no_numpy():
    code = "import sys, autotuner; sys.exit('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_from_recording_to_gains():
    plant = SteppedPlant(Fopdt(2.0, 10.0, 1.5), output0=40.0, pv0=80.0, sensors=[Noise(0.05, seed=2)])
    t, output, pv = np.arange(0.0, 80.0, 0.2), [], []
    for k, moment in enumerate(t):
        plant.advance(float(moment))
        pv.append(plant.measure())
        plant.output = 40.0 if k < 20 else 50.0
        output.append(plant.output)
    recording = autotuner.Recording(t, np.array(output), np.array(pv))
    identification = autotuner.identify(recording)
    assert pytest.approx(2.0, rel=0.02) == identification.model.K
    assert pytest.approx(10.0, rel=0.05) == identification.model.T
    tuning = autotuner.design(identification.model, goal="calm")
    assert isinstance(tuning.gains, autotuner.PidGains)
    assert tuning.gains.Kp > 0.0
