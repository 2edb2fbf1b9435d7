"""The batch of plants for the benches of the experiment: from lag to dead time, second order, integrating.

Each rests at output 40 and PV 80 and moves by 2 PV for a unit of output, or as fast when it integrates. `sample_s` is
an eighth of the dead time, or a third of the lag where that is shorter.
"""

from dataclasses import dataclass

from autotuner_sim import Fopdt, Integrating, Plant, SopdtOverdamped, SopdtUnderdamped

OUTPUT0, PV0, AMPLITUDE = 40.0, 80.0, 10.0
LAG_S = 10.0


@dataclass(frozen=True)
class BatchPlant:
    name: str
    plant: Plant
    sample_s: float


def _fopdt(ratio):
    dead_s = ratio * LAG_S
    return BatchPlant(f"FOPDT D/T {ratio:g}", Fopdt(2.0, LAG_S, dead_s), min(dead_s / 8.0, LAG_S / 3.0))


BATCH = (
    *(_fopdt(ratio) for ratio in (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)),
    BatchPlant("SOPDT overdamped", SopdtOverdamped(2.0, 10.0, 5.0, 3.0), 3.0 / 8.0),
    BatchPlant("SOPDT underdamped", SopdtUnderdamped(2.0, 25.0, 4.0, 3.0), 3.0 / 8.0),
    BatchPlant("integrating", Integrating(0.2, 0.0, 2.0), 2.0 / 8.0),
    BatchPlant("integrating with lag", Integrating(0.2, 3.0, 2.0), 2.0 / 8.0),
)
