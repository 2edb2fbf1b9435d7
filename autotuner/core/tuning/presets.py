"""Devices and textbook forms as rows: how each states its gains.

A row is what the maker's manual says, named in `source`. What a device calls its numbers stands in `labels`.
"""

from __future__ import annotations

from autotuner.core.tuning.forms import Form, Gain, Integral, Structure
from autotuner.errors import InputError

_TEXTBOOK = "Astrom and Hagglund, Advanced PID Control, 2006, section 3.2"

FORMS: dict[str, Form] = {
    form.name: form
    for form in (
        Form("ideal", "ISA ideal, seconds", _TEXTBOOK, signed=True),
        Form("ideal_minutes", "ISA ideal, minutes", _TEXTBOOK, time_unit_s=60.0, signed=True),
        Form(
            "ideal_repeats_per_minute",
            "ISA ideal, repeats per minute and minutes",
            _TEXTBOOK,
            integral=Integral.RATE,
            time_unit_s=60.0,
            signed=True,
            labels=("Kp", "repeats/min", "Td"),
        ),
        Form(
            "parallel",
            "Parallel, seconds",
            _TEXTBOOK,
            structure=Structure.PARALLEL,
            integral=Integral.GAIN,
            signed=True,
            labels=("Kp", "Ki", "Kd"),
        ),
        Form(
            "series", "Series, seconds", _TEXTBOOK, structure=Structure.SERIES, signed=True, labels=("Kc", "Ti", "Td")
        ),
        Form(
            "proportional_band",
            "Proportional band in % of span, seconds",
            _TEXTBOOK,
            gain=Gain.BAND,
            pv_full=100.0,
            output_full=100.0,
            labels=("PB", "Ti", "Td"),
        ),
        Form(
            "siemens_pid_compact",
            "Siemens PID_Compact",
            "Siemens, PID control function manual, A5E35300227: output in %, PV in engineering units, Ti = 0 is off",
            output_full=100.0,
            labels=("Gain", "Ti", "Td"),
        ),
        Form(
            "rockwell_pide_independent",
            "Rockwell PIDE, independent gains",
            "Rockwell, 1756-RM006: error in % of span, Ki in 1/min, Kd in min",
            structure=Structure.PARALLEL,
            integral=Integral.GAIN,
            time_unit_s=60.0,
            pv_full=100.0,
            output_full=100.0,
            labels=("PGain", "IGain", "DGain"),
        ),
        Form(
            "rockwell_pide_dependent",
            "Rockwell PIDE, dependent gains",
            "Rockwell, 1756-RM006: error in % of span, Ti in minutes per repeat, Td in min",
            time_unit_s=60.0,
            pv_full=100.0,
            output_full=100.0,
            labels=("PGain", "IGain", "DGain"),
        ),
        Form(
            "schneider_pidff",
            "Schneider PIDFF, mixed structure",
            "Schneider Electric, Control block library, PIDFF: gain by the ratio of the ranges, times in ms",
            time_unit_s=0.001,
            pv_full=1.0,
            output_full=1.0,
            labels=("kp", "ti", "td"),
        ),
        Form(
            "eurotherm",
            "Eurotherm PB, Ti, Td",
            "Eurotherm, 2000 series engineering handbook: band in % of the display range, times in s, off is 0",
            gain=Gain.BAND,
            pv_full=100.0,
            output_full=100.0,
            labels=("Pb", "ti", "td"),
        ),
        Form(
            "eurotherm_units",
            "Eurotherm PB in engineering units, Ti, Td",
            "Eurotherm, 3000 series engineering handbook: band in display units, times in s, off is 0",
            gain=Gain.BAND,
            output_full=100.0,
            labels=("PB", "ti", "td"),
        ),
        Form(
            "omron_e5c",
            "Omron E5_C, temperature input",
            "Omron, E5_C user's manual H174: band in degrees, integral and derivative time in s, 0 is off",
            gain=Gain.BAND,
            output_full=100.0,
            labels=("P", "I", "D"),
        ),
        Form(
            "omron_e5c_analog",
            "Omron E5_C, analogue input",
            "Omron, E5_C user's manual H174: band in % of full scale, integral and derivative time in s, 0 is off",
            gain=Gain.BAND,
            pv_full=100.0,
            output_full=100.0,
            labels=("P", "I", "D"),
        ),
        Form(
            "yokogawa",
            "Yokogawa UT and CENTUM",
            "Yokogawa, UTAdvanced user's manual: band in % of the PV range, times in s, 0 is off",
            gain=Gain.BAND,
            pv_full=100.0,
            output_full=100.0,
            labels=("P", "I", "D"),
        ),
        Form(
            "klipper",
            "Klipper heater",
            "Klipper, configuration reference and heaters.py: output 0 to 1 as gains over 255, seconds",
            structure=Structure.PARALLEL,
            integral=Integral.GAIN,
            output_full=255.0,
            labels=("pid_Kp", "pid_Ki", "pid_Kd"),
        ),
        Form(
            "marlin",
            "Marlin hotend (M301) and bed (M304)",
            "Marlin, M301: output 0 to 255 counts, Ki per s, Kd in s",
            structure=Structure.PARALLEL,
            integral=Integral.GAIN,
            output_full=255.0,
            labels=("P", "I", "D"),
        ),
    )
}
"""All forms by the name that configurations use."""


def form_named(name: str) -> Form:
    """Return the form of that name.

    Raises
    ------
    InputError
        No form has this name.
    """
    if name not in FORMS:
        raise InputError("is not a known PID form", field="form", value=name, remedy=f"Use one of {', '.join(FORMS)}.")
    return FORMS[name]
