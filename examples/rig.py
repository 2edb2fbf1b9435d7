"""A rig in plain Python for `python_loop.toml`: replace the function bodies by access to your hardware.

The simulated rig is a heater: gain 0.8 degC/%, time constant 5 s, dead time 0.5 s, in a room of 20 degC.
"""

import math
import time

commands = [(time.monotonic(), 40.0)]  # (time at which the heater follows, output in %)
temperature, at = 52.0, time.monotonic()


def read_temperature() -> float:
    """Return the temperature, degC."""
    global temperature, at  # noqa: PLW0603 - a real rig keeps its state in the hardware
    now = time.monotonic()
    while at < now:
        while len(commands) > 1 and commands[1][0] <= at:
            commands.pop(0)
        until = min(now, commands[1][0] if len(commands) > 1 else now)
        target = 20.0 + 0.8 * commands[0][1]
        temperature = target + (temperature - target) * math.exp(-(until - at) / 5.0)
        at = until
    return temperature


def get_heater() -> float:
    """Return the heater's output, %."""
    return commands[-1][1]


def set_heater(percent: float) -> None:
    """Set the heater, %."""
    commands.append((time.monotonic() + 0.5, percent))
