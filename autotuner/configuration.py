"""The configuration: one TOML file of loops, checked at start.

Rules of this file: an unknown key is an error, not a surprise; every error names the key, the value and the remedy; a
loop's `device` table goes to its driver verbatim and is checked there.
"""

from __future__ import annotations

import hashlib
import json
import math
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from autotuner.core.settings import ExperimentSettings, Limits, Side
from autotuner.errors import ConfigurationError, InputError, UnknownLoopError
from autotuner.validation import validated

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.safety import SafetySettings
    from autotuner.core.tuning.gains import PidGains

Number = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Positive = Annotated[Number, Field(gt=0.0)]
NotNegative = Annotated[Number, Field(ge=0.0)]
Whole = Annotated[int, Field(strict=True)]
Flag = Annotated[bool, Field(strict=True)]


class Table(BaseModel):
    """A table of the file: frozen, and closed to unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


FAST_S = 0.02
"""Longest sample time, s, of a loop for which a millisecond counts."""
DERIVATIVE_FILTER = 0.1
"""Filter time of a derivative where none is given, in derivative times."""
TRAVEL_STROKES = 100.0
"""Travel allowed where none is given, in strokes of the actuator: twice what the longest relay experiment needs."""


class LimitsTable(Table):
    """`[loops.NAME.limits]`: what the output and the PV must never pass."""

    output: tuple[Number, Number] = (0.0, 100.0)
    pv: tuple[Number, Number] | None = None
    output_slew_per_s: Positive | None = None
    safe_output: Number | None = None


class OnlineTable(Table):
    """`[loops.NAME.relay.online]`: a controller that keeps running beside the relay, in the ideal form."""

    Kp: Number
    Ti: Positive | None = None
    Td: NotNegative = 0.0
    Tf: NotNegative | None = None
    b: Number = 1.0

    def gains(self) -> PidGains:
        """Return the controller; a derivative without a filter gets one of a tenth of its time."""
        from autotuner.core.tuning.gains import PidGains  # noqa: PLC0415 - brings SciPy with it

        filter_s = DERIVATIVE_FILTER * self.Td if self.Tf is None else self.Tf
        return PidGains(self.Kp, math.inf if self.Ti is None else self.Ti, self.Td, filter_s, self.b)


class RelayTable(Table):
    """`[loops.NAME.relay]`: how the experiment is run; what is left out follows from the measured noise."""

    amplitude: Positive | None = None
    ratio: Positive = 2.0
    pv_amplitude: Positive | None = None
    max_amplitude: Positive | None = None
    side: Side | None = None
    drift_compensation: Flag = False
    hysteresis: NotNegative | None = None
    quiet_s: Positive | None = None
    min_periods: Whole = 3
    max_periods: Whole = 12
    accuracy: Positive = 0.01
    check: Flag = True
    response_limit_s: Positive = 7200.0
    time_limit_s: Positive = 86400.0
    online: OnlineTable | None = None


class SafetyTable(Table):
    """`[loops.NAME.safety]`: what ends a tuning beside the limits."""

    blind_s: Positive | None = None
    late_s: Positive | None = None
    frozen_samples: Annotated[Whole, Field(ge=3)] = 20
    travel: Positive | None = None
    energy: Positive | None = None
    phase_limit_s: Positive | None = None
    device_gone: Literal["end", "wait"] = "end"


class GainsTable(Table):
    """`[loops.NAME.gains]`: where the device's own PID controller keeps its gains, and how it states them."""

    form: Annotated[str, Field(min_length=1)]
    gain: Annotated[str, Field(min_length=1)] = "kp"
    integral: Annotated[str, Field(min_length=1)] = "ti"
    derivative: str = "td"
    pv_span: Positive | None = None
    output_span: Positive | None = None
    set_point_weight: NotNegative = 1.0
    derivative_filter: Positive | None = None
    scan_s: Positive | None = None

    @property
    def signals(self) -> dict[str, str]:
        """The driver's signals by the part of the controller that each holds; no derivative where there is none."""
        given = {"gain": self.gain, "integral": self.integral, "derivative": self.derivative}
        return {part: signal for part, signal in given.items() if signal}


class LoopTable(Table):
    """`[loops.NAME]`: one PV, one output, one driver."""

    driver: str
    sample_time_s: Positive = 1.0
    action: Literal["direct", "reverse"] = "direct"
    pv_unit: str = ""
    output_unit: str = ""
    limits: LimitsTable = LimitsTable()
    relay: RelayTable = RelayTable()
    safety: SafetyTable = SafetyTable()
    gains: GainsTable | None = None
    device: dict[str, Any] = Field(default_factory=dict)
    restore_limit_s: Positive = 600.0
    own_process: Flag | None = None

    def experiment_settings(self, **overrides: object) -> ExperimentSettings:
        """Return the experiment's settings; `overrides` are fields of `[relay]`, None meaning not given.

        Raises
        ------
        InputError
            A value that cannot work; names the field.
        """
        given = {name: value for name, value in overrides.items() if value is not None}
        relay = validated(RelayTable, {**self.relay.model_dump(), **given}, "relay")
        limits = self.limits.model_dump(exclude_none=True)
        return ExperimentSettings(
            sample_time_s=self.sample_time_s,
            limits=Limits(**limits),
            direct=self.action == "direct",
            **relay.model_dump() | {"online": relay.online and relay.online.gains()},
        )

    @property
    def device_key(self) -> str:
        """What tells this loop's device from another: a hash of driver and options."""
        text = json.dumps([self.driver, self.device], sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def safety_settings(self, time_limit_s: float | None = None) -> SafetySettings:
        """Return what the supervisor watches beside the limits.

        `time_limit_s` is that of the experiment, by default the loop's: the supervisor's own stands a little behind.
        """
        from autotuner.core.safety import SafetySettings  # noqa: PLC0415 - only for a loop that is driven: it needs NumPy

        given = self.safety.model_dump(exclude_none=True)
        late_s = max(5.0 * self.sample_time_s, 1.0)
        low, high = self.limits.output
        defaults = {
            "blind_s": max(10.0 * self.sample_time_s, 2.0),
            "late_s": late_s,
            "travel": TRAVEL_STROKES * (high - low),
            "time_limit_s": (time_limit_s or self.relay.time_limit_s) + 2.0 * late_s,
        }
        return SafetySettings(**(defaults | given))


class ServiceTable(Table):
    """`[service]`: where the REST service listens, the largest recording that it takes, and what of tunings is kept."""

    host: Annotated[str, Field(min_length=1)] = "127.0.0.1"
    port: Annotated[Whole, Field(ge=0, le=65535)] = 8321
    data_directory: Annotated[str, Field(min_length=1)] = "autotuner-data"
    upload_limit_bytes: Annotated[Whole, Field(gt=0)] = 32 * 1024 * 1024
    names: tuple[Annotated[str, Field(min_length=1)], ...] = ()
    certificate: str | None = None
    private_key: str | None = None
    requests_per_s: Positive = 100.0
    connections_limit: Annotated[Whole, Field(gt=0)] = 256
    log: Literal["text", "json"] = "text"
    database_url: Annotated[str, Field(min_length=1)] | None = None
    keep_tunings: Annotated[Whole, Field(gt=0)] = 2000
    keep_bytes: Annotated[Whole, Field(gt=0)] = 4 * 1024**3
    real_time: Annotated[Whole, Field(ge=0, le=99)] = 0


class Configuration(Table):
    """The whole file."""

    service: ServiceTable = ServiceTable()
    loops: dict[str, LoopTable] = Field(min_length=1)

    def is_urgent(self, loop: LoopTable) -> bool:
        """Return whether a millisecond counts for a loop, and the service is in the real-time class."""
        return self.service.real_time > 0 and loop.sample_time_s <= FAST_S

    def listening_on(self, host: str | None, port: int | None) -> Configuration:
        """Return the same configuration with another address; None keeps what the file says."""
        given = {name: value for name, value in (("host", host), ("port", port)) if value is not None}
        service = validated(ServiceTable, {**self.service.model_dump(), **given}, "service")
        return self.model_copy(update={"service": service})

    def loop(self, name: str) -> LoopTable:
        """Return a loop's table; raise `UnknownLoopError` with the names that exist."""
        if name not in self.loops:
            raise UnknownLoopError(
                "is not a configured loop", field="loop", value=name, remedy=f"Use one of {', '.join(self.loops)}."
            )
        return self.loops[name]


DEMO: Mapping[str, object] = {
    "loops": {
        "demo": {
            "driver": "simulated",
            "sample_time_s": 0.1,
            "pv_unit": "degC",
            "output_unit": "%",
            "limits": {"output": [0.0, 100.0], "pv": [0.0, 250.0]},
            "relay": {"amplitude": 10.0},
            "gains": {"form": "ideal", "derivative_filter": 8.0},
            "device": {
                "plant": {"structure": "fopdt", "K": 2.0, "T": 10.0, "D": 1.5},
                "output0": 40.0,
                "pv0": 80.0,
                "noise": 0.05,
                "seed": 1,
            },
        }
    }
}
"""What runs when no configuration is given: a simulated heater."""

DEFAULT_FILE = Path("autotuner.toml")


def load_configuration(path: Path | None = None) -> Configuration:
    """Read a configuration.

    Parameters
    ----------
    path : Path, optional
        The file; without it `autotuner.toml` in the working directory, and without that the built-in demo loop.

    Raises
    ------
    ConfigurationError
        The file cannot be read, is no TOML, or a key is wrong; names the key, the value and the remedy.
    """
    if path is None and not DEFAULT_FILE.exists():
        return parse_configuration(DEMO, "demo")
    file = path or DEFAULT_FILE
    try:
        values = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigurationError(
            f"cannot be read: {error.strerror}", field=str(file), remedy="Check the path and its permissions."
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigurationError(
            f"is not valid TOML: {error}", field=str(file), remedy="Correct that place."
        ) from error
    return parse_configuration(values, str(file))


def parse_configuration(values: Mapping[str, object], source: str) -> Configuration:
    """Check the values of a configuration; `source` stands in front of the key in errors."""
    configuration = validated(Configuration, values, source)
    for name, loop in configuration.loops.items():
        try:
            loop.experiment_settings()
        except InputError as error:
            place = _place(error.field or "")
            raise ConfigurationError(
                error.message, field=f"{source}: loops.{name}.{place}", value=error.value, remedy=error.remedy
            ) from error
    return configuration


def _place(field: str) -> str:
    """Return where a setting of the experiment stands in its loop's table."""
    return f"relay.{field}" if field.partition(".")[0] in RelayTable.model_fields else field
