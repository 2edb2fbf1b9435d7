"""Linear plants with dead time, and their exact motion while the input is constant."""

from autotuner_sim.plants.linear import (
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
from autotuner_sim.plants.rational import RationalPlant

__all__ = [
    "PLANTS",
    "Fopdt",
    "Integrating",
    "InverseResponse",
    "LagChain",
    "Plant",
    "RationalPlant",
    "SopdtOverdamped",
    "SopdtUnderdamped",
    "UnstableFopdt",
]
