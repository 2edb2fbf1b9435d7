"""Simulated plants and devices. Imports nothing of the tuner, so that it can judge it."""

from autotuner_sim.batch import CycleBatch, RelayTests, cycle_batch, relay_tests
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
from autotuner_sim.quick import QuickRun, quick_relay
from autotuner_sim.relay import Relay, RelayRun, symmetric_relay
from autotuner_sim.relay_beside_pid import BesideRun, Pid, run_relay_beside_pid
from autotuner_sim.relay_course import run_relay
from autotuner_sim.stepped import SteppedPlant

__all__ = [
    "PLANTS",
    "Backlash",
    "BesideRun",
    "CycleBatch",
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
    "QuickRun",
    "RateLimit",
    "Relay",
    "RelayRun",
    "RelayTests",
    "Saturation",
    "SopdtOverdamped",
    "SopdtUnderdamped",
    "SteppedPlant",
    "Stiction",
    "UnstableFopdt",
    "cycle_batch",
    "find_limit_cycle",
    "quick_relay",
    "relay_tests",
    "run_relay",
    "run_relay_beside_pid",
    "symmetric_relay",
]
