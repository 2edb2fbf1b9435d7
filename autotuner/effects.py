"""Names for a package that adds physics to the diagnosis; see `docs/how-to/add-your-own-physics.md`."""

from autotuner.core.diagnosis.conformance import check_effect
from autotuner.core.diagnosis.extended.effect import Effect, Place, Searched, View
from autotuner.core.effect_plugins import GROUP, EffectPlugin

__all__ = ["GROUP", "Effect", "EffectPlugin", "Place", "Searched", "View", "check_effect"]
