"""Devices and textbook forms as rows: how each states its gains.

A row follows the maker's manual, which `source` names. `labels` holds the device's own names of the numbers.
"""

from __future__ import annotations

from autotuner.core.design.forms.pid_forms import Form, Gain, Integral, ModeSwitch, Structure
from autotuner.errors import InputError

_PIDE_MODE = ModeSwitch(
    "Auto",
    (1,),
    (0,),
    "CVOper (Operator control), CVProg (Program control)",
    "Auto and Manual are status bits. In Program control set ProgAutoReq or ProgManualReq, in Operator control "
    "OperAutoReq or OperManualReq; the instruction clears the requests of the operator.",
)
_EUROTHERM_MODE = ModeSwitch(
    "A-M (Modbus 273, mnemonic mA)",
    (0,),
    (1,),
    "OP (Modbus 3)",
    "Automatic is 0. Eurotherm, 2000 series communications handbook HA026230.",
)
_OMRON_MODE = ModeSwitch(
    "operation command 09 (Modbus register 0)",
    (0x0900,),
    (0x0901,),
    "Manual MV",
    "The register is written only; the mode is read from the bit Auto/Manual of the status. Omron, E5_C "
    "communications manual H175.",
)
_NO_MANUAL = "The firmware has no manual mode: a heater that is switched off has the output 0."
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
            mode=ModeSwitch(
                "State",
                (3,),
                (4,),
                "ManualValue",
                "State is read only. ManualEnable true is manual, its falling edge automatic; or write Mode (3 "
                "automatic, 4 manual) and give an edge at ModeActivate.",
            ),
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
            mode=_PIDE_MODE,
        ),
        Form(
            "rockwell_pide_dependent",
            "Rockwell PIDE, dependent gains",
            "Rockwell, 1756-RM006: error in % of span, Ti in minutes per repeat, Td in min",
            time_unit_s=60.0,
            pv_full=100.0,
            output_full=100.0,
            labels=("PGain", "IGain", "DGain"),
            mode=_PIDE_MODE,
        ),
        Form(
            "schneider_pidff",
            "Schneider PIDFF, mixed structure",
            "Schneider Electric, Control block library, PIDFF: gain by the ratio of the ranges, times in ms",
            time_unit_s=0.001,
            pv_full=1.0,
            output_full=1.0,
            labels=("kp", "ti", "td"),
            mode=ModeSwitch("MAN_AUTO", (1,), (0,), "OUT", "The block writes OUT in automatic."),
        ),
        Form(
            "eurotherm",
            "Eurotherm PB, Ti, Td",
            "Eurotherm, 2000 series engineering handbook: band in % of the display range, times in s, off is 0",
            gain=Gain.BAND,
            pv_full=100.0,
            output_full=100.0,
            labels=("Pb", "ti", "td"),
            mode=_EUROTHERM_MODE,
        ),
        Form(
            "eurotherm_units",
            "Eurotherm PB in engineering units, Ti, Td",
            "Eurotherm, 3000 series engineering handbook: band in display units, times in s, off is 0",
            gain=Gain.BAND,
            output_full=100.0,
            labels=("PB", "ti", "td"),
            mode=_EUROTHERM_MODE,
        ),
        Form(
            "omron_e5c",
            "Omron E5_C, temperature input",
            "Omron, E5_C user's manual H174: band in degrees, integral and derivative time in s, 0 is off",
            gain=Gain.BAND,
            output_full=100.0,
            labels=("P", "I", "D"),
            mode=_OMRON_MODE,
        ),
        Form(
            "omron_e5c_analog",
            "Omron E5_C, analogue input",
            "Omron, E5_C user's manual H174: band in % of full scale, integral and derivative time in s, 0 is off",
            gain=Gain.BAND,
            pv_full=100.0,
            output_full=100.0,
            labels=("P", "I", "D"),
            mode=_OMRON_MODE,
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
            "west",
            "West 6100+, 8100+ and Pro-EC",
            "West, Plus series product manual 59305: band in % of the input span, reset and rate in s, 0 is off",
            gain=Gain.BAND,
            pv_full=100.0,
            output_full=100.0,
            labels=("Proportional Band", "Automatic Reset", "Rate"),
            mode=ModeSwitch(
                "Auto/Manual Control (bit parameter 2)", (0,), (1,), "Manual Power", "Automatic is 0, manual is 1."
            ),
        ),
        Form(
            "codesys",
            "CODESYS PID of the library Util",
            "CODESYS online help, library Util, function block PID: Y = Y_OFFSET + KP (e + 1/TN int e + TV de/dt), TN "
            "and TV in s; TN = 0 is not allowed, so a time of 1e9 s stands for no integral action",
            integral_off=1e9,
            labels=("KP", "TN", "TV"),
            mode=ModeSwitch("MANUAL", (0,), (1,), "Y_MANUAL", "RESET true sets the output to Y_OFFSET."),
        ),
        Form(
            "tclab",
            "PID of the TCLab course",
            "APMonitor, Temperature Control Lab: OP = OP0 + Kc e + Kc/tauI int e - Kc tauD dPV/dt, OP in %",
            output_full=100.0,
            labels=("Kc", "tauI", "tauD"),
            mode=ModeSwitch("none", note="The controller is a program of the host's; the board has heaters only."),
        ),
        Form(
            "arduino_pid",
            "Arduino PID library (PID_v1)",
            "Beauregard, Arduino-PID-Library, PID_v1.cpp: output 0 to 255 (SetOutputLimits), Ki per s, Kd in s",
            structure=Structure.PARALLEL,
            integral=Integral.GAIN,
            output_full=255.0,
            labels=("Kp", "Ki", "Kd"),
            mode=ModeSwitch(
                "SetMode", (1,), (0,), "Output", "MANUAL is 0, AUTOMATIC 1; the change to automatic is bumpless."
            ),
        ),
        Form(
            "esphome",
            "ESPHome PID climate",
            "ESPHome documentation, PID climate: output 0 to 1, ki per s, kd in s",
            structure=Structure.PARALLEL,
            integral=Integral.GAIN,
            output_full=1.0,
            labels=("kp", "ki", "kd"),
            mode=ModeSwitch(
                "mode of the climate",
                manual_output="level of the output component",
                note="heat, cool and heat_cool are automatic. In off the controller sets its output to 0 once and "
                "leaves it, so that the output component can be driven.",
            ),
        ),
        Form(
            "klipper",
            "Klipper heater",
            "Klipper, configuration reference and heaters.py: output 0 to 1 as gains over 255, seconds",
            structure=Structure.PARALLEL,
            integral=Integral.GAIN,
            output_full=255.0,
            labels=("pid_Kp", "pid_Ki", "pid_Kd"),
            mode=ModeSwitch(
                "heater target", note=f"{_NO_MANUAL} PID_CALIBRATE drives the relay of the firmware's own."
            ),
        ),
        Form(
            "marlin",
            "Marlin hotend (M301) and bed (M304)",
            "Marlin, M301: output 0 to 255 counts, Ki per s, Kd in s",
            structure=Structure.PARALLEL,
            integral=Integral.GAIN,
            output_full=255.0,
            labels=("P", "I", "D"),
            mode=ModeSwitch("M104, M140", note=f"{_NO_MANUAL} M303 drives the relay of the firmware's own."),
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
