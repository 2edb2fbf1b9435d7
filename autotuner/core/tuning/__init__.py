"""Gains: PID forms, rules, margins and closed-loop predictions."""

from typing import TYPE_CHECKING

from autotuner.core.on_demand import on_demand

if TYPE_CHECKING:
    from autotuner.core.tuning.as_wished import gains_as_wished
    from autotuner.core.tuning.closed_loop import Prediction, Scenario, predict
    from autotuner.core.tuning.device import HeldGains, held_by_device
    from autotuner.core.tuning.forms import DeviceGains, Form, Spans, from_device, rounded, to_device
    from autotuner.core.tuning.gains import Action, PidGains, controller_response, gains_from_dict
    from autotuner.core.tuning.loop_margins import Margins, is_stable, margins
    from autotuner.core.tuning.merging import MergedLags, known_within, merged
    from autotuner.core.tuning.named_rules import rule_named, rule_names
    from autotuner.core.tuning.pid import PidSettings
    from autotuner.core.tuning.presets import FORMS, form_named
    from autotuner.core.tuning.requirements import GOALS, Controller, Noise, NoiseLimit, Purpose, Requirements
    from autotuner.core.tuning.result import Candidate, Tuning
    from autotuner.core.tuning.robust import Design, design
    from autotuner.core.tuning.rules import RuleResult, apply_rule
    from autotuner.core.tuning.schedule import GainSchedule, gain_schedule, heat_cool
    from autotuner.core.tuning.tuner import tune
    from autotuner.core.tuning.ultimate import UltimatePoint, ultimate_point
    from autotuner.core.tuning.uncertainty import Interval
    from autotuner.core.tuning.verification import Decision, Verification, predicted_band
    from autotuner.core.tuning.wish import Basis, Wish, noise_of, wish_from
else:
    __getattr__ = on_demand(
        __name__,
        {
            "as_wished": "gains_as_wished",
            "closed_loop": "Prediction Scenario predict",
            "device": "HeldGains held_by_device",
            "forms": "DeviceGains Form Spans from_device rounded to_device",
            "gains": "Action PidGains controller_response gains_from_dict",
            "loop_margins": "Margins is_stable margins",
            "merging": "MergedLags known_within merged",
            "pid": "PidSettings",
            "presets": "FORMS form_named",
            "requirements": "GOALS Controller Noise NoiseLimit Purpose Requirements",
            "result": "Candidate Tuning",
            "robust": "Design design",
            "rules": "RuleResult apply_rule",
            "named_rules": "rule_named rule_names",
            "schedule": "GainSchedule gain_schedule heat_cool",
            "tuner": "tune",
            "ultimate": "UltimatePoint ultimate_point",
            "uncertainty": "Interval",
            "verification": "Decision Verification predicted_band",
            "wish": "Basis Wish noise_of wish_from",
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
    "DeviceGains",
    "Form",
    "GainSchedule",
    "HeldGains",
    "Interval",
    "Margins",
    "MergedLags",
    "Noise",
    "NoiseLimit",
    "PidGains",
    "PidSettings",
    "Prediction",
    "Purpose",
    "Requirements",
    "RuleResult",
    "Scenario",
    "Spans",
    "Tuning",
    "UltimatePoint",
    "Verification",
    "Wish",
    "apply_rule",
    "controller_response",
    "design",
    "form_named",
    "from_device",
    "gain_schedule",
    "gains_as_wished",
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
    "rounded",
    "rule_named",
    "rule_names",
    "to_device",
    "tune",
    "ultimate_point",
    "wish_from",
]
