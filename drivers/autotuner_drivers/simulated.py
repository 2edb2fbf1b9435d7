"""Driver `simulated`: a plant of `autotuner_sim` with a device and its controller, on the event loop's clock.

Options (table ``[loops.NAME.device]``), with their defaults::

    plant = { structure = "fopdt", K = 2.0, T = 10.0, D = 1.5 }      # required; structures as in autotuner_sim.plants
    output0 = 0.0                    # initial output, at which the plant is at rest
    pv0 = 0.0                        # initial PV
    noise = 0.0                      # standard deviation of the reading, PV units
    quantisation = 0.0                    # resolution of the reading, PV units
    seed = 0
    output_limits = [0.0, 100.0]     # limits of the device, which clips commands to them
    effects = [{ effect = "backlash", width = 1.0 }]                 # default none; names in autotuner_sim.devices
    auto = false                     # whether the device's controller is in automatic at the start
    set_point = 0.0                  # of that controller; default pv0
    gains = { kp = 1.0, ti = 20.0, td = 0.0 }
    scan_s = 0.1                     # of that controller
    named = "NAME"                   # default none; a name, for the outer loop of a cascade
    drives = "NAME"                  # default none; the inner loop: its set point is the output, its PV the input

The plant starts with the first `open` and continues while the backend is closed, as a real process does.
"""

from __future__ import annotations

import asyncio
import math
import weakref
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

from autotuner.errors import ConfigurationError, LinkError
from autotuner.ports import AUTO, OUTPUT, PV, SET_POINT
from autotuner_drivers.options import Options, check_finite, check_names
from autotuner_sim.cascade import OuterDevice
from autotuner_sim.devices.loop_device import Gains, LoopDevice
from autotuner_sim.devices.plant_options import EFFECTS, build_plant, parameters_of
from autotuner_sim.plants import PLANTS

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping

    from autotuner_sim.devices.plant_options import Effect
    from autotuner_sim.stepped import SteppedPlant

GAIN_NAMES = ("kp", "ti", "td")


class SimulatedBackend:
    """A loop in memory; implements `autotuner.ports.Backend`.

    Parameters
    ----------
        device : LoopDevice
            The simulated device; its time 0 is the first call of `open`.
        shared : bool
            Whether the outer loop of a cascade uses the device too.
    """

    simulated = True

    def __init__(self, device: LoopDevice, *, shared: bool = False) -> None:
        self._device, self._shared = device, shared
        self._start_s: float | None = None
        self._opened = False

    @property
    def readable(self) -> frozenset[str]:
        """All signals."""
        return _READABLE

    @property
    def writable(self) -> frozenset[str]:
        """All signals but the PV."""
        return _WRITABLE

    async def open(self) -> None:
        """Start the plant on the first call."""
        self.start()
        self._opened = True

    def start(self) -> tuple[LoopDevice, float]:
        """Start the plant on the first call; return the device and its start on the event loop's clock, s."""
        if self._start_s is None:
            self._start_s = asyncio.get_running_loop().time()
        return self._device, self._start_s

    async def read(self, names: Collection[str]) -> dict[str, float]:
        """Return the named signals at the present time; each reading of the PV has new noise."""
        check_names(names, self.readable, "read")
        device = self._present()
        return {name: float(_READS[name](device)) for name in names}

    async def write(self, values: Mapping[str, float]) -> None:
        """Set the named signals in the order given."""
        check_names(values, self.writable, "write")
        check_finite(values)
        device = self._present()
        for name, value in values.items():
            _WRITES[name](device, value)

    async def close(self) -> None:
        """Disconnect; the plant continues."""
        self._opened = False

    def carried(self) -> object:
        """Return the device and its start time; the clock is the same in every process."""
        return None if self._shared else (self._device, self._start_s)

    def take_over(self, device: object) -> None:
        """Continue with the device that `carried` returned."""
        self._device, self._start_s = cast("tuple[LoopDevice, float | None]", device)

    def _present(self) -> LoopDevice:
        if not self._opened or self._start_s is None:
            raise LinkError("the simulated device is not open", remedy="Open the backend first.")
        self._device.advance(asyncio.get_running_loop().time() - self._start_s)
        return self._device


class OuterBackend(SimulatedBackend):
    """Outer loop of a cascade; its device is created on the first `open`, around that of the inner loop.

    Parameters
    ----------
    inner : str
            Name of the inner device, its option `named`.
        make : callable
            Returns the outer device for the inner device.
    """

    def __init__(self, inner: str, make: Callable[[LoopDevice], LoopDevice]) -> None:
        self._inner, self._make = inner, make
        self._start_s, self._opened, self._shared = None, False, True

    def start(self) -> tuple[LoopDevice, float]:
        """Start both loops on the first call; raise `LinkError` where the inner device is missing."""
        if self._start_s is None:
            if (inner := _NAMED.get(self._inner)) is None:
                remedy = f'Give the device of the inner loop the option named = "{self._inner}".'
                raise LinkError("no simulated device has this name", field="drives", value=self._inner, remedy=remedy)
            device, self._start_s = inner.start()
            self._device = self._make(device)
        return self._device, self._start_s


_NAMED: weakref.WeakValueDictionary[str, SimulatedBackend] = weakref.WeakValueDictionary()
"""Inner loops by name, as long as their backends are in use."""


def _write_auto(device: LoopDevice, value: float) -> None:
    device.auto = value != 0.0


def _write_set_point(device: LoopDevice, value: float) -> None:
    device.set_point = value


def _read_gain(name: str) -> Callable[[LoopDevice], float]:
    return lambda device: float(getattr(device.gains, name))


def _write_gain(name: str) -> Callable[[LoopDevice, float], None]:
    def write(device: LoopDevice, value: float) -> None:
        device.gains = replace(device.gains, **{name: value})

    return write


_READS: dict[str, Callable[[LoopDevice], float]] = {
    PV: lambda device: device.measure(),
    OUTPUT: lambda device: device.output,
    SET_POINT: lambda device: device.set_point,
    AUTO: lambda device: device.auto,
    **{name: _read_gain(name) for name in GAIN_NAMES},
}

_WRITES: dict[str, Callable[[LoopDevice, float], None]] = {
    OUTPUT: lambda device, value: device.command(value),
    SET_POINT: _write_set_point,
    AUTO: _write_auto,
    **{name: _write_gain(name) for name in GAIN_NAMES},
}

_READABLE, _WRITABLE = frozenset(_READS), frozenset(_WRITES)


def create(options: Mapping[str, object]) -> SimulatedBackend:
    """Return a closed backend for the options of a loop's device.

    Raises
    ------
    ConfigurationError
        Names the key, the value and the remedy.
    """
    table = Options(options)
    limits = table.span("output_limits", (0.0, 100.0))
    named, drives = (table.text(key) if key in table else "" for key in ("named", "drives"))
    # the inner PV is the outer input, and the limits of the inner set point do not apply to it
    plant = _plant(table, (-math.inf, math.inf) if drives else limits)
    gains = table.table("gains", {})
    settings: dict[str, Any] = {
        "scan_s": table.number("scan_s", 0.1, low=0.001, high=3600.0, unit="s"),
        "limits": limits,
        "gains": Gains(
            kp=gains.number("kp", 1.0),
            ti=gains.number("ti", 20.0, low=0.0, unit="s"),
            td=gains.number("td", 0.0, low=0.0, unit="s"),
        ),
        "set_point": table.number("set_point", plant.pv),
        "auto": table.flag("auto", default=False),
    }
    gains.done()
    table.done()
    if drives:
        return OuterBackend(drives, lambda inner: OuterDevice(inner, plant, **settings))
    backend = SimulatedBackend(LoopDevice(plant, **settings), shared=bool(named))
    if named:
        _NAMED[named] = backend
    return backend


def _plant(table: Options, limits: tuple[float, float]) -> SteppedPlant:
    model = table.table("plant")
    structure = model.choice("structure", tuple(PLANTS))
    parameters = _parameters(model, PLANTS[structure])
    model.done()
    try:
        return build_plant(
            structure,
            parameters,
            output0=table.number("output0", 0.0),
            pv0=table.number("pv0", 0.0),
            noise=table.number("noise", 0.0, low=0.0),
            quantisation=table.number("quantisation", 0.0, low=0.0),
            seed=table.integer("seed", 0, low=0, high=2**63),
            limits=limits,
            with_effects=[_effect(effect) for effect in table.tables("effects")],
        )
    except ValueError as error:
        raise ConfigurationError(
            str(error), field=table.key("plant"), remedy="Correct the plant, its effects or its rest point."
        ) from error


def _effect(table: Options) -> Effect:
    name = table.choice("effect", tuple(EFFECTS))
    values = _parameters(table, EFFECTS[name][1])
    table.done()
    return name, values


def _parameters(table: Options, kind: type) -> dict[str, float | tuple[float, ...]]:
    return {
        parameter.name: table.number_list(parameter.name) if parameter.many else table.number(parameter.name)
        for parameter in parameters_of(kind)
        if parameter.name in table or not parameter.optional
    }
