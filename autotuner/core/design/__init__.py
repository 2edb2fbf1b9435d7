"""Gains: PID forms, rules, margins and closed-loop predictions."""

from typing import TYPE_CHECKING

from autotuner.core.lazy_imports import lazy_names

if TYPE_CHECKING:
    from autotuner.core.design.design_procedure import design_from_spec, with_prediction
    from autotuner.core.design.design_spec import Basis, DesignSpec, design_spec_from, noise_of
    from autotuner.core.design.device_controller import DeviceController
    from autotuner.core.design.forms.held_gains import HeldGains, held_by_device
    from autotuner.core.design.forms.pid_forms import DeviceGains, Form, Spans, from_device, rounded, to_device
    from autotuner.core.design.forms.presets import FORMS, form_named
    from autotuner.core.design.gains import Action, PidGains, controller_response, gains_from_dict
    from autotuner.core.design.loop_margins import Margins, is_stable, margins
    from autotuner.core.design.optimisation.robust import Design, design
    from autotuner.core.design.optimisation.uncertainty import Interval
    from autotuner.core.design.pid_design import Candidate, PidDesign, tune
    from autotuner.core.design.requirements import GOALS, Controller, Noise, NoiseLimit, Purpose, Requirements
    from autotuner.core.design.rules.reduction import MergedLags, known_within, merged
    from autotuner.core.design.rules.rule_table import rule_named, rule_names
    from autotuner.core.design.rules.tuning_rules import RuleResult, apply_rule
    from autotuner.core.design.rules.ultimate import UltimatePoint, ultimate_point
    from autotuner.core.design.schedule import GainSchedule, gain_schedule, heat_cool
    from autotuner.core.design.simulation.closed_loop import Prediction, Scenario, predict
    from autotuner.core.design.simulation.closed_loop_setup import Installed, LoopPrediction, predicted_loop
    from autotuner.core.design.simulation.pid import PidSettings
    from autotuner.core.design.simulation.verification import Decision, Verification, predicted_band
else:
    __getattr__ = lazy_names(
        __name__,
        {
            "autotuner.core.design.simulation.closed_loop": "Prediction Scenario predict",
            "autotuner.core.design.forms.held_gains": "HeldGains held_by_device",
            "autotuner.core.design.forms.pid_forms": "DeviceGains Form Spans from_device rounded to_device",
            "autotuner.core.design.gains": "Action PidGains controller_response gains_from_dict",
            "autotuner.core.design.loop_margins": "Margins is_stable margins",
            "autotuner.core.design.rules.reduction": "MergedLags known_within merged",
            "autotuner.core.design.simulation.pid": "PidSettings",
            "autotuner.core.design.forms.presets": "FORMS form_named",
            "autotuner.core.design.requirements": "GOALS Controller Noise NoiseLimit Purpose Requirements",
            "autotuner.core.design.pid_design": "Candidate PidDesign tune",
            "autotuner.core.design.optimisation.robust": "Design design",
            "autotuner.core.design.rules.tuning_rules": "RuleResult apply_rule",
            "autotuner.core.design.rules.rule_table": "rule_named rule_names",
            "autotuner.core.design.schedule": "GainSchedule gain_schedule heat_cool",
            "autotuner.core.design.rules.ultimate": "UltimatePoint ultimate_point",
            "autotuner.core.design.optimisation.uncertainty": "Interval",
            "autotuner.core.design.simulation.verification": "Decision Verification predicted_band",
            "autotuner.core.design.design_procedure": "design_from_spec with_prediction",
            "autotuner.core.design.design_spec": "Basis DesignSpec design_spec_from noise_of",
            "autotuner.core.design.device_controller": "DeviceController",
            "autotuner.core.design.simulation.closed_loop_setup": "Installed LoopPrediction predicted_loop",
        },
    )

__all__ = [
    "FORMS",
    "GOALS",
    "Action",
    "Basis",
    "Candidate",
    "Controller",
    "Decision",
    "Design",
    "DesignSpec",
    "DeviceController",
    "DeviceGains",
    "Form",
    "GainSchedule",
    "HeldGains",
    "Installed",
    "Interval",
    "LoopPrediction",
    "Margins",
    "MergedLags",
    "Noise",
    "NoiseLimit",
    "PidDesign",
    "PidGains",
    "PidSettings",
    "Prediction",
    "Purpose",
    "Requirements",
    "RuleResult",
    "Scenario",
    "Spans",
    "UltimatePoint",
    "Verification",
    "apply_rule",
    "controller_response",
    "design",
    "design_from_spec",
    "design_spec_from",
    "form_named",
    "from_device",
    "gain_schedule",
    "gains_from_dict",
    "heat_cool",
    "held_by_device",
    "is_stable",
    "known_within",
    "margins",
    "merged",
    "noise_of",
    "predict",
    "predicted_band",
    "predicted_loop",
    "rounded",
    "rule_named",
    "rule_names",
    "to_device",
    "tune",
    "ultimate_point",
    "with_prediction",
]
