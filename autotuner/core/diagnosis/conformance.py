"""Conformance checks of an effect from another package: properties that the diagnosis relies on.

    from autotuner.effects import check_effect
    assert check_effect(plugin) == []

The checks run on a record of random steps through a lag with dead time, made here.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from autotuner.core.diagnosis.extended.base import base_of
from autotuner.core.diagnosis.extended.fit_context import bench_of
from autotuner.core.diagnosis.findings.advice import REMEDIES
from autotuner.core.diagnosis.record.dataset import dataset_of
from autotuner.core.model.process import Fopdt, ProcessModel
from autotuner.core.recording import Recording

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from autotuner.core.diagnosis.extended.effect import Effect
    from autotuner.core.diagnosis.extended.extended_model import Fitted
    from autotuner.core.effect_plugins import EffectPlugin

SAMPLES, HOLD, LAG = 400, 20, 12.0


def check_effect(plugin: EffectPlugin) -> list[str]:
    """Return the faults of a plug-in, as texts; empty where it conforms.

    Parameters
    ----------
    plugin : EffectPlugin
        The plug-in to check.
    """
    wrong = []
    if not plugin.name.isidentifier() or plugin.name != plugin.name.lower():
        wrong.append(f"the name {plugin.name!r} is not of lower-case letters, digits and underlines")
    if plugin.name in REMEDIES:
        wrong.append(f"the catalogue has an effect with the name {plugin.name}")
    base = _process_alone()
    forms = list(plugin.make(base.problem.dataset, base))
    if not forms:
        wrong.append("make returns no form for a record of steps")
    for form in chain(forms, *(form.other_forms for form in forms)):
        wrong += [f"{plugin.name} {form.form}: {fault}".replace(" :", ":") for fault in _of_form(plugin, form, base)]
    return wrong


def _process_alone() -> Fitted:
    """Return the process alone on a record of random steps."""
    random = np.random.default_rng(1)
    output = np.repeat(random.uniform(30.0, 50.0, SAMPLES // HOLD), HOLD)
    output[:HOLD] = 40.0
    pv = np.zeros(SAMPLES)
    for k in range(1, SAMPLES):
        pv[k] = pv[k - 1] + (2.0 * (output[max(k - 4, 0)] - 40.0) - pv[k - 1]) / LAG
    recording = Recording(np.arange(float(SAMPLES)), output, 60.0 + pv + random.normal(0.0, 0.05, SAMPLES))
    base = base_of(bench_of(dataset_of(recording)), ("offset",), 0)
    assert base is not None  # noqa: S101 - the record is made above
    return base.best


def _of_form(plugin: EffectPlugin, form: Effect, base: Fitted) -> Iterator[str]:
    if form.name != plugin.name:
        yield f"is named {form.name}, not {plugin.name}"
    if not form.starts:
        yield "has no starts"
    if all(f is None for f in (form.position, form.transport, form.response, form.columns, form.load)):
        yield "changes nothing: it has neither position, transport, response, columns nor load"
        return
    for start in form.starts:
        yield from _of_start(plugin, form, base, start)


def _of_start(plugin: EffectPlugin, form: Effect, base: Fitted, start: tuple[float, ...]) -> Iterator[str]:
    if len(start) != len(form.searched):
        yield f"the start {start} has not one value for each searched number"
        return
    outside = [s.name for s, value in zip(form.searched, start, strict=True) if not s.low <= value <= s.high]
    if outside:
        yield f"the start {start} lies outside of the bounds of {', '.join(outside)}"
    problem = replace(base.problem, effects=(form,))
    theta = np.concatenate([base.theta, np.array(start, dtype=np.float64)])
    rows = problem.rows
    columns, counts = problem.columns(theta, rows)
    if not np.isfinite(columns).all():
        yield f"the simulation at {start} is not finite"
        return
    if not np.array_equal(columns, problem.columns(theta, rows)[0]):
        yield f"two simulations at {start} differ"
    linear = np.linalg.lstsq(columns, problem.dataset.data.pv[rows], rcond=None)[0]
    sizes = dict(form.sizes(start, linear[1 : 1 + counts[0]].tolist(), float(linear[0])))
    if not sizes or not all(math.isfinite(value) for value in sizes.values()):
        yield f"the sizes at {start} are not finite numbers: {sizes}"
        return
    yield from _of_sizes(plugin, sizes)


def _of_sizes(plugin: EffectPlugin, sizes: Mapping[str, float]) -> Iterator[str]:
    try:
        plugin.advice.format(**sizes)
    except (KeyError, IndexError, ValueError) as error:
        yield f"the advice cannot be written with the sizes {sorted(sizes)}: {error!r}"
    if plugin.element is not None:
        if plugin.element(sizes)(0.0) != 0.0:
            yield "the element is not at rest at 0"
        if [plugin.element(sizes)(u) for u in (1.0, -1.0)] != [plugin.element(sizes)(u) for u in (1.0, -1.0)]:
            yield "two new elements differ"
    if plugin.controller_view is not None:
        view: object = plugin.controller_view(Fopdt(2.0, LAG, 4.0), sizes)
        if view is not None and not isinstance(view, ProcessModel):
            yield "the controller's view is not a process model"
