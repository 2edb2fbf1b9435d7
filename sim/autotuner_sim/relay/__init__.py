"""Relay tests: exact runs, steady limit cycles, a relay in parallel with a controller."""

from autotuner_sim.relay.limit_cycle import LimitCycle, find_limit_cycle
from autotuner_sim.relay.parallel_pid import ParallelRun, Pid, run_parallel_relay
from autotuner_sim.relay.run import Knot, Relay, RelayRun, run_relay, symmetric_relay

__all__ = [
    "Knot",
    "LimitCycle",
    "ParallelRun",
    "Pid",
    "Relay",
    "RelayRun",
    "find_limit_cycle",
    "run_parallel_relay",
    "run_relay",
    "symmetric_relay",
]
