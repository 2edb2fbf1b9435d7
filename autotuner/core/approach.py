"""Finding a PV to oscillate about when the present output lies at the edge of the relay's range.

A loop at rest with its output at a limit (a cold oven at 0 %) has its equilibrium at the edge: a relay about the
present PV would never switch back. So the output is held at the far level until the PV has answered and moved on, and
the reference is put on that way:

    t1   time until the PV has moved by `threshold`
    r1   rise of the PV from t1 to 2 t1,   r2   rise from 2 t1 to 3 t1
    reference = pv0 + (1/2 + 1/2 r2/r1) (pv(3 t1) - pv0),  r2/r1 limited to 0..1

`r2/r1` near 1 is a lag-dominated process, far from settled: its PV itself serves. Near 0 it has settled: half way up
serves.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(slots=True)
class Approach:
    """The push towards the far level.

    Attributes
    ----------
    started_s : float
        Time of the push, s.
    pv0 : float
        PV at rest, PV units.
    threshold : float
        Move of the PV that counts as an answer, PV units.
    """

    started_s: float
    pv0: float
    threshold: float
    _marks: list[float] = field(default_factory=list)
    _answered_s: float | None = None

    def step(self, t: float, pv: float) -> float | None:
        """Take a sample; return the reference once it is found.

        The marks are the PV at `t1`, `2 t1` and `3 t1` after the push.
        """
        elapsed = t - self.started_s
        if self._answered_s is None:
            if abs(pv - self.pv0) < self.threshold:
                return None
            self._answered_s = elapsed
        if elapsed >= self._answered_s * (len(self._marks) + 1):
            self._marks.append(pv)
        if len(self._marks) < 3:
            return None
        first, second, third = self._marks
        slowing = (third - second) / (second - first) if second != first else 0.0
        return self.pv0 + (0.5 + 0.5 * min(max(slowing, 0.0), 1.0)) * (third - self.pv0)
