"""The gains of a device's own controller: which signals hold them, in which form, and how exactly.

Invariants:

1. A table that cannot work is refused when it is made, with the key at fault, before anything is connected.
2. Written values are those that the registers can hold; gains outside of their range are refused before the first
   write.
3. Numbers of the device keep its own names and units; only `PidGains` are in the ideal form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from autotuner.core.design import (
    Action,
    DeviceController,
    DeviceGains,
    PidGains,
    Spans,
    form_named,
    from_device,
    held_by_device,
    to_device,
)
from autotuner.errors import ConfigurationError, DeviceRefusedError, InputError
from autotuner.ports import Ranged

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.configuration import GainsTable, LoopTable
    from autotuner.core.design import Form, HeldGains
    from autotuner.core.model.process import ProcessModel
    from autotuner.ports import Backend

HALF = 0.5 + 1e-6
"""Largest difference between a written and a held value, in steps of the register: rounding."""
UNKNOWN_STEP = 1e-6
"""Relative difference treated as equal, where a driver does not report its resolution."""


@runtime_checkable
class _Steps(Protocol):
    def resolution(self, name: str, value: float) -> float: ...


@dataclass(frozen=True, slots=True)
class DeviceForm:
    """Form and signals of the gains of one device.

    Attributes
    ----------
    form : Form
        Its form.
    spans : Spans
        What it normalises by.
    signals : dict of str to str
        Signal of the driver by part of the controller: ``gain``, ``integral``, and ``derivative`` where it has one.
    action : Action
        What a rising PV does to the output of a controller of this loop.
    b : float
        Weight of the set point in the device, which no register changes.
    N : float
        Filter of the derivative in the device, likewise.
    scan_s : float
        Time between two moves of the device's controller, s.
    slew_per_s : float
        Fastest change of its output, output units/s.
    backend : Backend
        The device; only the ranges of its registers are used.
    """

    form: Form
    spans: Spans
    signals: dict[str, str]
    action: Action
    b: float
    N: float
    scan_s: float
    slew_per_s: float
    backend: Backend

    def held(self, gains: PidGains, model: ProcessModel | None = None) -> HeldGains:
        """Return the gains as the device will hold them, with margins on the model.

        Raises
        ------
        InputError
            The form cannot hold them, the device has no derivative, or they are not for the process action of the loop.
        DeviceRefusedError
            They are beyond a register's range.
        """
        if gains.action is not self.action:
            raise InputError(
                f"has the wrong sign: the controller of this loop must be {self.action.value} acting",
                field="gains.Kp",
                value=gains.Kp,
                remedy="Correct the gains, or the loop's key process_action.",
            )
        if gains.Td > 0.0 and "derivative" not in self.signals:
            raise InputError(
                "cannot be held: the device has no derivative",
                field="gains.Td",
                value=gains.Td,
                remedy="Choose a rule of a PI controller, such as amigo_pi, or map gains.derivative.",
            )
        exact = to_device(gains, self.form, self.spans)
        steps = {part: _step(self.backend, signal, getattr(exact, part)) for part, signal in self.signals.items()}
        resolution = {part: step for part, step in steps.items() if step > 0.0}
        held = held_by_device(
            gains,
            self.form.name,
            spans=self.spans,
            resolution=resolution,
            model=model,
            fixed_b=self.b,
            fixed_N=self.N,
        )
        for name, value in self.values(held.device).items():
            self._check_range(name, value)
        return held

    @property
    def controller(self) -> DeviceController:
        """The device's controller as designs and predictions take it; steps of its registers are those near 1."""
        steps = {part: _step(self.backend, signal, 1.0) for part, signal in self.signals.items()}
        resolution = {part: step for part, step in steps.items() if step > 0.0}
        derivative = "derivative" in self.signals
        own = (self.spans, resolution, self.scan_s, self.slew_per_s)
        return DeviceController(self.form.name, self.b, self.N, derivative, *own)

    def values(self, device: DeviceGains) -> dict[str, float]:
        """Return the number of each signal."""
        return {signal: float(getattr(device, part)) for part, signal in self.signals.items()}

    def gains(self, values: Mapping[str, float]) -> PidGains | None:
        """Return the controller that the device's numbers make, None when they make none (a gain of 0)."""
        parts = {part: values[signal] for part, signal in self.signals.items()}
        try:
            held = DeviceGains(**{"derivative": 0.0} | parts, action=self.action, b=self.b)
            return replace(from_device(held, self.form, self.spans), N=self.N)
        except (InputError, ZeroDivisionError):
            return None

    def differing(self, held: Mapping[str, float], wanted: Mapping[str, float]) -> str | None:
        """Return the first signal whose register does not hold the requested value."""
        missed = (name for name, value in wanted.items() if not same_number(self.backend, name, held[name], value))
        return next(missed, None)

    def _check_range(self, name: str, value: float) -> None:
        low, high = self.backend.limits(name) if isinstance(self.backend, Ranged) else (-math.inf, math.inf)
        if not low <= value <= high:
            raise DeviceRefusedError(
                f"does not fit its register, which holds {low:g} to {high:g}",
                field=name,
                value=value,
                remedy="Correct scale or type of the register, or the form of [gains]; nothing was written.",
            )


def same_number(backend: Backend, name: str, held: float, wanted: float) -> bool:
    """Return whether a device holds the written value of a signal, up to its resolution."""
    step = _step(backend, name, wanted)
    return abs(held - wanted) <= (HALF * step if step > 0.0 else UNKNOWN_STEP * abs(wanted))


def _step(backend: Backend, name: str, value: float) -> float:
    return backend.resolution(name, value) if isinstance(backend, _Steps) else 0.0


def device_form(loop: LoopTable, backend: Backend, field: str) -> DeviceForm | None:
    """Return how the loop's device states its gains; None where the configuration does not state it.

    Parameters
    ----------
    loop : LoopTable
        The loop.
    backend : Backend
        Its device.
    field : str
        Dotted key of the loop, for messages.

    Raises
    ------
    ConfigurationError
        An unknown form, a span that is missing, a signal that cannot be read and written; names the key.
    """
    table = loop.gains
    if table is None:
        return None
    form = _form(table, field)
    for part, signal in table.signals.items():
        _check_signal(f"{field}.gains.{part}", signal, backend)
    if (twice := len(set(table.signals.values())) < len(table.signals)) or not table.signals:
        raise ConfigurationError(
            "names one signal twice" if twice else "names no signal",
            field=f"{field}.gains",
            value=list(table.signals.values()),
            remedy="Give gain, integral and derivative a signal each.",
        )
    action = Action.REVERSE if loop.process_action == "direct" else Action.DIRECT
    spans = Spans(table.pv_span, table.output_span)
    N = table.derivative_filter or math.inf
    scan_s = min(table.scan_s or loop.sample_time_s, loop.sample_time_s)
    own = (table.set_point_weight, N, scan_s, table.output_slew_per_s or math.inf)
    return DeviceForm(form, spans, table.signals, action, *own, backend)


def controller_of(table: GainsTable, sample_time_s: float, field: str) -> DeviceController:
    """Return the controller that a table describes, without a device to ask for the steps of its registers.

    Raises
    ------
    ConfigurationError
        An unknown form, or a span that is missing; names the key.
    """
    return DeviceController(
        _form(table, field).name,
        table.set_point_weight,
        table.derivative_filter or math.inf,
        bool(table.derivative),
        Spans(table.pv_span, table.output_span),
        scan_s=table.scan_s or sample_time_s,
        slew_per_s=table.output_slew_per_s or math.inf,
    )


def required_form(loop: LoopTable, backend: Backend, name: str) -> DeviceForm:
    """Return how the device states its gains; raise `InputError` where the configuration does not state it."""
    found = device_form(loop, backend, f"loops.{name}")
    if found is None:
        raise InputError(
            "does not state where the device keeps its gains, so they cannot be written",
            field=f"loops.{name}.gains",
            remedy="Map the gains as signals of the driver and describe them in [loops.NAME.gains]; "
            "or enter them in the device by hand.",
        )
    return found


def _form(table: GainsTable, field: str) -> Form:
    try:
        form = form_named(table.form)
    except InputError as error:
        raise ConfigurationError(
            error.message, field=f"{field}.gains.form", value=table.form, remedy=error.remedy
        ) from error
    needed = {"pv_span": form.pv_full, "output_span": form.output_full}
    for key, full in needed.items():
        if full is not None and getattr(table, key) is None:
            raise ConfigurationError(
                f"is missing: {form.title} states its gain against it",
                field=f"{field}.gains.{key}",
                remedy=f"Give the full range of the {key.partition('_')[0]} as the device is set up, highest minus "
                "lowest.",
            )
    return form


def _check_signal(key: str, signal: str, backend: Backend) -> None:
    wrong = {"read": signal not in backend.readable, "written": signal not in backend.writable}
    for what, holds in wrong.items():
        if holds:
            both = ", ".join(sorted(backend.readable & backend.writable))
            raise ConfigurationError(
                f"names a signal that cannot be {what} on this device",
                field=key,
                value=signal,
                remedy=f"Map that signal for the driver, or use one of {both}.",
            )
