"""Simulated plants and devices. Imports nothing of the tuner, so that it can judge it."""

from autotuner_sim.actuators import (
    ActuatorHold,
    DirectionGain,
    EqualPercentage,
    PowerLaw,
    SoftRateLimit,
    SoftSaturation,
    UnequalLag,
    UnequalWait,
)
from autotuner_sim.batch import CycleBatch, RelayTests, cycle_batch, relay_tests
from autotuner_sim.couplings import (
    ConvectiveLoss,
    DirectionDynamics,
    Fouling,
    GainDrift,
    Overflow,
    Radiation,
    SquareRootOutflow,
    Thermostat,
    Weir,
)
from autotuner_sim.disturbances import BiasStep, CurvedDrift, LoadRamp, Measured, PeriodicLoad, PeriodicOffset
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
from autotuner_sim.friction import ChoudhuryStiction, HeStiction, KanoStiction, PositionBacklash
from autotuner_sim.limit_cycle import LimitCycle, find_limit_cycle
from autotuner_sim.noisy_batch import NoisyBatch, noisy_batch
from autotuner_sim.noisy_relay import SampledRun, noisy_relay
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
from autotuner_sim.quick import PeriodicRun, quick_relay
from autotuner_sim.quick_pending import PendingRun
from autotuner_sim.quick_swings import QuickRun
from autotuner_sim.rational import RationalPlant
from autotuner_sim.relay import Relay, RelayRun, symmetric_relay
from autotuner_sim.relay_beside_pid import BesideRun, Pid, run_relay_beside_pid
from autotuner_sim.relay_course import run_relay
from autotuner_sim.sensors import ColouredNoise, Freeze, HeavyTailedNoise, Jitter, SendOnDelta, Spikes
from autotuner_sim.stepped import SteppedPlant
from autotuner_sim.transport import FixedDelay, PlugFlow

__all__ = [
    "PLANTS",
    "ActuatorHold",
    "Backlash",
    "BesideRun",
    "BiasStep",
    "ChoudhuryStiction",
    "ColouredNoise",
    "ConvectiveLoss",
    "CurvedDrift",
    "CycleBatch",
    "DirectionDynamics",
    "DirectionGain",
    "Drift",
    "EqualPercentage",
    "FixedDelay",
    "Fopdt",
    "Fouling",
    "Freeze",
    "GainDrift",
    "HeStiction",
    "HeavyTailedNoise",
    "Integrating",
    "InverseResponse",
    "Jitter",
    "KanoStiction",
    "LagChain",
    "LimitCycle",
    "LoadRamp",
    "LoadStep",
    "Measured",
    "Noise",
    "NoisyBatch",
    "OutputQuantisation",
    "Overflow",
    "PendingRun",
    "PeriodicLoad",
    "PeriodicOffset",
    "PeriodicRun",
    "Pid",
    "Plant",
    "PlugFlow",
    "PositionBacklash",
    "PowerLaw",
    "Quantisation",
    "QuickRun",
    "Radiation",
    "RateLimit",
    "RationalPlant",
    "Relay",
    "RelayRun",
    "RelayTests",
    "SampledRun",
    "Saturation",
    "SendOnDelta",
    "SoftRateLimit",
    "SoftSaturation",
    "SopdtOverdamped",
    "SopdtUnderdamped",
    "Spikes",
    "SquareRootOutflow",
    "SteppedPlant",
    "Stiction",
    "Thermostat",
    "UnequalLag",
    "UnequalWait",
    "UnstableFopdt",
    "Weir",
    "cycle_batch",
    "find_limit_cycle",
    "noisy_batch",
    "noisy_relay",
    "quick_relay",
    "relay_tests",
    "run_relay",
    "run_relay_beside_pid",
    "symmetric_relay",
]
