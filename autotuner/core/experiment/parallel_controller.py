"""Parallel controller: a PID controller that keeps running with the relay, so that the loop stays controlled.

    output = v + (wanted - output0),   v = PID(pv),   which gives (N + Gc(jw)) G(jw) = -1

`wanted` the output requested by a stage of the experiment, `output0` the output before the experiment, `v` the
controller's part, all in output units: the relay adds its deviation from rest to a controller that holds the PV at its
rest (thesis section 1.3.2).

Invariants:

1. The controller runs from the first sample on, without a bump; its set point is the mean PV of the quiet phase.
2. The relay keeps its full swing: at a limit of the output the controller's part is reduced, without windup.
3. The sum can be separated again: `relay_part` computes the relay's own output from a recording.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.design.gains import gains_from_dict
from autotuner.core.design.simulation.pid import PidSettings, started, step
from autotuner.core.experiment.relay import Relay, SwitchFilter
from autotuner.core.recording import Recording

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.design.gains import PidGains
    from autotuner.core.design.simulation.pid import PidState
    from autotuner.core.recording import Sample

FEWEST_SAMPLES = 2
"""Fewest samples of a mean."""


class Parallel:
    """The controller in parallel with the stages of one experiment.

    Parameters
    ----------
    gains : PidGains
        The controller.
    output : float
        Output before the experiment, output units.
    limits : tuple of float
        Lowest and highest output of the sum, output units.
    """

    def __init__(self, gains: PidGains, output: float, limits: tuple[float, float]) -> None:
        self._gains = gains
        self._rest_output = output
        self._limits = limits
        self._rested = 0
        self._set_point = 0.0
        self._state: PidState | None = None

    def step(self, sample: Sample, wanted: float, *, resting: bool) -> float:
        """Return the output of both, output units.

        Parameters
        ----------
        sample : Sample
            The latest sample.
        wanted : float
            Output requested by the experiment's stage.
        resting : bool
            Whether the loop still rests, so that the set point follows the PV's mean; true for the first sample.
        """
        if resting:
            self._rested += 1
            self._set_point += (sample.pv - self._set_point) / self._rested
        added = wanted - self._rest_output
        low, high = self._limits
        settings = PidSettings(self._gains, low - added, high - added)
        if self._state is None:
            self._state = started(settings, sample.t, sample.pv, self._set_point, self._rest_output)
        else:
            self._state = step(settings, self._state, sample.t, sample.pv, self._set_point)
        return self._state.output + added


@dataclass(frozen=True, slots=True, eq=False)
class RelayPart:
    """The relay of an experiment with a parallel controller, separated from its recording.

    Attributes
    ----------
    recording : Recording
        The samples of the relay phase, the relay's own output in place of the sum.
    gains : PidGains
        The parallel controller.
    """

    recording: Recording
    gains: PidGains


def relay_part(recording: Recording) -> RelayPart | None:
    """Return the relay's part of a recording, or None for a recording without a parallel controller.

    The relay is run again over the recorded PV since it was last changed: it saw those samples and nothing else.
    """
    settings = recording.settings
    online, segments = settings.get("online"), recording.segments
    if not isinstance(online, dict) or "relay" not in segments:
        return None
    since_s = max(segments["relay"], float(settings.get("relay_since_s", -math.inf)))  # type: ignore[arg-type]
    rows = (recording.t >= since_s) & (recording.t <= segments.get("half_relay", math.inf))
    if np.count_nonzero(rows) < FEWEST_SAMPLES:
        return None
    t, pv = recording.t[rows], recording.pv[rows]
    gains = gains_from_dict(online)
    relay, output = _relay(settings, direct=gains.Kp > 0.0), []
    is_high = bool(settings.get("relay_began_high", True))
    switch_filter = _switch_filter(settings, relay.hysteresis)
    for value in pv.tolist():
        is_high = switch_filter.switched(relay, is_high=is_high, pv=value)
        output.append(relay.level(is_high=is_high))
    return RelayPart(Recording(t, np.array(output), pv), gains)


def _switch_filter(settings: Mapping[str, object], hysteresis: float) -> SwitchFilter:
    """Return the PV of the relay's decisions; recordings without an initial state are of a relay without a filter."""
    from_rest = settings.get("relay_from_rest")
    sigma = settings.get("disturbance_sigma", settings.get("noise_sigma"))
    if from_rest is None or not isinstance(sigma, float):
        return SwitchFilter(hysteresis, 0.0)
    return SwitchFilter(hysteresis, sigma, from_rest=bool(from_rest))


def _relay(settings: Mapping[str, object], *, direct: bool) -> Relay:
    low, high, reference, hysteresis = (
        float(settings[name])  # type: ignore[arg-type]
        for name in ("relay_low", "relay_high", "relay_reference", "hysteresis")
    )
    return Relay(low, high, reference, hysteresis, direct=direct)
