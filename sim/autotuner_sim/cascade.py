"""A cascade: the output of an outer loop is the set point of an inner one, whose PV drives the outer process.

    outer controller -> r1 [inner controller -> G1] -> y1 -> [G2] -> y2

    flow = LoopDevice(...)
    tank = OuterDevice(flow, SteppedPlant(...), scan_s=1.0)

Invariant: the outer loop advances with every scan of the inner device. Its process receives the inner PV at the scan
and holds it until the next one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from autotuner_sim.devices.loop_device import LoopDevice

if TYPE_CHECKING:
    from autotuner_sim.stepped import SteppedPlant


class OuterDevice(LoopDevice):
    """The outer loop of a cascade.

    Parameters
    ----------
    inner : LoopDevice
        The inner loop; its set point is the output of this one.
    process : SteppedPlant
        The process that the inner PV drives, at rest where its output is that PV.
    **settings
        Those of `LoopDevice`.
    """

    def __init__(self, inner: LoopDevice, process: SteppedPlant, **settings: Any) -> None:
        self._inner, self._process = inner, process
        super().__init__(_Outer(inner, process), **settings)
        inner.watchers.append(self._follow)

    def advance(self, t: float) -> None:
        """Go on to time `t`, s, and the inner loop with it."""
        self._inner.advance(t)
        super().advance(t)

    def _follow(self, t: float, inner_pv: float) -> None:
        super().advance(t)
        self._process.output = inner_pv


class _Outer:
    """Process of the outer controller: its input is the inner set point, its process follows the inner PV."""

    def __init__(self, inner: LoopDevice, process: SteppedPlant) -> None:
        self._inner, self._process = inner, process

    @property
    def t(self) -> float:
        return self._process.t

    @property
    def pv(self) -> float:
        return self._process.pv

    @property
    def output(self) -> float:
        return self._inner.set_point

    @output.setter
    def output(self, value: float) -> None:
        self._inner.set_point = value

    @property
    def position(self) -> float:
        return self._process.output

    def measure(self) -> float:
        return self._process.measure()

    def advance(self, t: float) -> None:
        self._process.advance(t)
