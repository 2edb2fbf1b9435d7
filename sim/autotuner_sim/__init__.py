"""Simulated plants and devices. Imports nothing of the tuner, so that it can judge it."""

from autotuner_sim.effects import (
    Backlash,
    Drift,
    LoadStep,
    Noise,
    OutputQuantisation,
    Quantisation,
    RateLimit,
    Saturation,
    Stiction,
)
from autotuner_sim.limit_cycle import LimitCycle, find_limit_cycle
from autotuner_sim.plants import (
    PLANTS,
    Fopdt,
    Integrating,
    InverseResponse,
    LagChain,
    Plant,
    SopdtOverdamped,
    SopdtUnderdamped,
    UnstableFopdt,
)
from autotuner_sim.relay import Relay, RelayRun, symmetric_relay
from autotuner_sim.relay_beside_pid import BesideRun, Pid, run_relay_beside_pid
from autotuner_sim.relay_course import run_relay
from autotuner_sim.stepped import SteppedPlant

__all__ = [
    "PLANTS",
    "Backlash",
    "BesideRun",
    "Drift",
    "Fopdt",
    "Integrating",
    "InverseResponse",
    "LagChain",
    "LimitCycle",
    "LoadStep",
    "Noise",
    "OutputQuantisation",
    "Pid",
    "Plant",
    "Quantisation",
    "RateLimit",
    "Relay",
    "RelayRun",
    "Saturation",
    "SopdtOverdamped",
    "SopdtUnderdamped",
    "SteppedPlant",
    "Stiction",
    "UnstableFopdt",
    "find_limit_cycle",
    "run_relay",
    "run_relay_beside_pid",
    "symmetric_relay",
]
