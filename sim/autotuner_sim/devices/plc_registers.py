"""Registers of the simulated PLC: their addresses, and the effect of a write.

    table     address   signal       type             unit
    input     0         pv           int16  x 0.1     PV, as read at the last scan
    input     1         position     int16  x 0.1     output, position of the actuator
    input     2         scans        uint16           scans, modulo 32768
    input     3         outer_pv     int16  x 0.1     PV of the outer process of a cascade, 0 without one
    holding   0         output       int16  x 0.1     output
    holding   1         set_point    int16  x 0.1     PV
    holding   2         heartbeat    uint16           beats of the master, 0 when it is done
    holding   10, 11    kp           float32          output/PV
    holding   12, 13    ti           float32          s
    holding   14, 15    td           float32          s
    coil      0         auto         bit              1: its own PID drives the output
    discrete  0         alarm        bit              the master fell silent, the watchdog has taken over

The outer loop of a cascade has the set point for its output. High word first, high byte first. A reading beyond the
register shows its end, as converters do.
"""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from autotuner_sim.devices.loop_device import LoopDevice

HOLDING_COUNT = 16
"""Holding registers of the simulated PLC."""
INPUT_COUNT = 4
"""Input registers of the simulated PLC."""
GAINS = {10: "kp", 12: "ti", 14: "td"}
"""First register of each gain."""


def input_words(device: LoopDevice, outer: LoopDevice | None = None) -> list[int]:
    """Return the input registers from 0; `outer` is the outer loop in a cascade."""
    outer_pv = 0.0 if outer is None else outer.reading
    return [_tenths(device.reading), _tenths(device.position), device.scans % 32768, _tenths(outer_pv)]


def holding_words(device: LoopDevice) -> list[int]:
    """Return the holding registers from 0."""
    words = [_tenths(device.output), _tenths(device.set_point), device.beat] + [0] * (HOLDING_COUNT - 3)
    for address, name in GAINS.items():
        words[address : address + 2] = struct.unpack(">HH", struct.pack(">f", getattr(device.gains, name)))
    return words


def write_holding(device: LoopDevice, address: int, words: Sequence[int]) -> bool:
    """Write registers from `address` on; return False, and change nothing, for a gain that is negative or no number."""
    updated = holding_words(device)
    updated[address : address + len(words)] = words
    touched = range(address, address + len(words))
    gains = {name: _float(updated, at) for at, name in GAINS.items() if at in touched or at + 1 in touched}
    if any(not math.isfinite(gain) for gain in gains.values()) or any(gains.get(t, 0.0) < 0.0 for t in ("ti", "td")):
        return False
    device.gains = replace(device.gains, **gains)
    if 2 in touched:
        device.take_beat(updated[2])
    if 1 in touched:
        device.set_point = _signed(updated[1]) / 10.0
    if 0 in touched:
        device.command(_signed(updated[0]) / 10.0)
    return True


def _tenths(value: float) -> int:
    return max(-32768, min(32767, round(value * 10.0))) & 0xFFFF


def _signed(word: int) -> int:
    return word - 0x10000 if word & 0x8000 else word


def _float(words: Sequence[int], address: int) -> float:
    value: float = struct.unpack(">f", struct.pack(">HH", *words[address : address + 2]))[0]
    return value
