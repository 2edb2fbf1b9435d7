"""Closed-loop simulation: the PID algorithm, actuators, predictions and the judge of a verification."""
