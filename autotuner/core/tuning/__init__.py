"""Gains: PID forms, rules, margins and closed-loop predictions."""

from autotuner.core.tuning.forms import DeviceGains, Form, Spans, from_device, rounded, to_device
from autotuner.core.tuning.gains import Action, PidGains, controller_response, gains_from_dict
from autotuner.core.tuning.margins import Margins, is_stable, margins
from autotuner.core.tuning.presets import FORMS, form_named
from autotuner.core.tuning.requirements import GOALS, Controller, NoiseLimit, Purpose, Requirements
from autotuner.core.tuning.robust import Design, design
from autotuner.core.tuning.rules import RuleResult, apply_rule, rule_named, rule_names
from autotuner.core.tuning.tuner import Candidate, Tuning, tune
from autotuner.core.tuning.ultimate import UltimatePoint, ultimate_point
from autotuner.core.tuning.uncertainty import Interval

__all__ = [
    "FORMS",
    "GOALS",
    "Action",
    "Candidate",
    "Controller",
    "Design",
    "DeviceGains",
    "Form",
    "Interval",
    "Margins",
    "NoiseLimit",
    "PidGains",
    "Purpose",
    "Requirements",
    "RuleResult",
    "Spans",
    "Tuning",
    "UltimatePoint",
    "apply_rule",
    "controller_response",
    "design",
    "form_named",
    "from_device",
    "gains_from_dict",
    "is_stable",
    "margins",
    "rounded",
    "rule_named",
    "rule_names",
    "to_device",
    "tune",
    "ultimate_point",
]
