"""Gains: PID forms, rules, margins and closed-loop predictions."""
