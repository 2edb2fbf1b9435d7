"""The configuration: one TOML file of loops, checked at start.

Invariants: an unknown key is an error, not a surprise; every error names the key, the value and the remedy; a
loop's `device` table goes to its driver verbatim and is checked there.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import tomllib
from ipaddress import ip_network
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from autotuner.core.experiment.settings import ExperimentSettings, Limits, Side
from autotuner.errors import ConfigurationError, InputError, UnknownLoopError
from autotuner.validation import validated

if TYPE_CHECKING:
    from collections.abc import Mapping

    from autotuner.core.design.gains import PidGains
    from autotuner.core.safety.supervisor import SafetySettings

log = logging.getLogger(__name__)

Number = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Positive = Annotated[Number, Field(gt=0.0)]
NotNegative = Annotated[Number, Field(ge=0.0)]
Whole = Annotated[int, Field(strict=True)]
Flag = Annotated[bool, Field(strict=True)]


RENAMED = {"blind_s": "pv_timeout_s", "late_s": "max_lateness_s", "action": "process_action"}
"""Keys of earlier versions and their present names; the old names are accepted, with a warning, in this version."""


def _network(given: str) -> str:
    """Return an address or a network as it was given; raise `ValueError` for anything else."""
    ip_network(given)
    return given


class Table(BaseModel):
    """A table of the file: frozen, and closed to unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _accept_old_names(cls, given: object) -> object:
        """Replace keys of earlier versions by their present names; both names at once leave an unknown key."""
        if not isinstance(given, dict):
            return given
        old = {key for key in given if RENAMED.get(key) in cls.model_fields and RENAMED[key] not in given}
        for key in sorted(old):
            log.warning("the key %s is now called %s; the old name is accepted in this version only", key, RENAMED[key])
        return {RENAMED[key] if key in old else key: value for key, value in given.items()}


SHORTEST_SAMPLE_TIME_S, LONGEST_SAMPLE_TIME_S = 0.001, 3600.0
"""Sample times between which a loop can be driven, s: below, the system keeps no deadline; above, a relay test of a
hundred samples takes four days."""
FAST_S = 0.02
"""Longest sample time, s, of a loop for which a millisecond counts."""
DERIVATIVE_FILTER = 0.1
"""Filter time of a derivative where none is given, in derivative times."""
TRAVEL_STROKES = 100.0
"""Default limit of the valve travel, strokes of the actuator: twice the longest relay experiment."""


class LimitsTable(Table):
    """`[loops.NAME.limits]`: limits of the output and of the PV."""

    output: tuple[Number, Number] = (0.0, 100.0)
    pv: tuple[Number, Number] | None = None
    output_slew_per_s: Positive | None = None
    safe_output: Number | None = None
    at_end: Literal["restore", "safe"] = "restore"


class OnlineTable(Table):
    """`[loops.NAME.relay.online]`: a controller in parallel with the relay, in the ideal form."""

    Kp: Number
    Ti: Positive | None = None
    Td: NotNegative = 0.0
    Tf: NotNegative | None = None
    b: Number = 1.0

    def gains(self) -> PidGains:
        """Return the controller; a derivative without a filter gets one of a tenth of its time."""
        from autotuner.core.design.gains import PidGains  # noqa: PLC0415 - brings SciPy with it

        filter_s = DERIVATIVE_FILTER * self.Td if self.Tf is None else self.Tf
        return PidGains(self.Kp, math.inf if self.Ti is None else self.Ti, self.Td, filter_s, self.b)


class RelayTable(Table):
    """`[loops.NAME.relay]`: settings of the experiment; defaults follow from the measured noise."""

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
    response_limit_s: Positive | None = None
    time_limit_s: Positive = 86400.0
    online: OnlineTable | None = None


class SafetyTable(Table):
    """`[loops.NAME.safety]`: conditions that end a tuning besides the limits."""

    pv_timeout_s: Positive | None = None
    max_lateness_s: Positive | None = None
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
    output_slew_per_s: Positive | None = None

    @property
    def signals(self) -> dict[str, str]:
        """Signals of the driver by the parameter of the controller; no derivative where there is none."""
        given = {"gain": self.gain, "integral": self.integral, "derivative": self.derivative}
        return {part: signal for part, signal in given.items() if signal}


class LoopTable(Table):
    """`[loops.NAME]`: one PV, one output, one driver."""

    driver: str
    sample_time_s: Annotated[Number, Field(ge=SHORTEST_SAMPLE_TIME_S, le=LONGEST_SAMPLE_TIME_S)] = 1.0
    process_action: Literal["direct", "reverse"] = "direct"
    pv_unit: str = ""
    output_unit: str = ""
    limits: LimitsTable = LimitsTable()
    relay: RelayTable = RelayTable()
    safety: SafetyTable = SafetyTable()
    gains: GainsTable | None = None
    device: dict[str, Any] = Field(default_factory=dict)
    restore_limit_s: Positive = 600.0
    scan_s: Positive = 0.5
    front_timeout_s: Positive = 5.0
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
            direct=self.process_action == "direct",
            **relay.model_dump() | {"online": relay.online and relay.online.gains()},
        )

    @property
    def device_scan_s(self) -> float:
        """Time after which the device acts on a write, s."""
        return (self.gains.scan_s if self.gains else None) or self.scan_s

    @property
    def device_key(self) -> str:
        """The identity of this loop's device: a hash of driver and options, without the options of the connection."""
        text = json.dumps([self.driver, _identity(self.device)], sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def safety_settings(self, time_limit_s: float | None = None) -> SafetySettings:
        """Return the settings of the supervisor besides the limits.

        `time_limit_s` is that of the experiment, by default the loop's; the supervisor's own limit is slightly longer.
        """
        from autotuner.core.safety.supervisor import SafetySettings  # noqa: PLC0415 - only for a loop that is driven: it needs NumPy

        given = self.safety.model_dump(exclude_none=True)
        max_lateness_s = max(5.0 * self.sample_time_s, 1.0)
        low, high = self.limits.output
        defaults = {
            "pv_timeout_s": max(10.0 * self.sample_time_s, 2.0),
            "max_lateness_s": max_lateness_s,
            "travel": TRAVEL_STROKES * (high - low),
            "time_limit_s": (time_limit_s or self.relay.time_limit_s) + 2.0 * max_lateness_s,
        }
        return SafetySettings(**(defaults | given))


def _identity(options: object) -> object:
    """Return options without those that a user may edit while the device stays the same."""
    if not isinstance(options, dict):
        return options
    return {name: _identity(value) for name, value in options.items() if name not in NOT_IDENTITY}


def state_directory() -> str:
    """Return where the state of this program is kept: the same in whatever folder it is started.

    It is that of the unit where systemd gives one (`StateDirectory=`), else that of the user on this platform.
    """
    from platformdirs import user_state_dir  # noqa: PLC0415 - only where the configuration names none

    given = os.environ.get("STATE_DIRECTORY", "").partition(os.pathsep)[0]
    return given or user_state_dir("relay-autotuner", appauthor=False)


NOT_IDENTITY = frozenset(
    {"timeout_s", "connection", "pause_s", "settle_s", "gap_s", "max_age_s"}
    | {"echo", "read_back", "retain", "tolerance", "max_registers_per_read", "max_bits_per_read", "max_gap"}
    | {"user", "password_file", "password_env", "key_file"}
)
"""Options of a driver for the communication, which identify neither the device nor its signals."""


class ServiceTable(Table):
    """`[service]`: address of the REST service, limits of requests, and retention of tunings."""

    host: Annotated[str, Field(min_length=1)] = "127.0.0.1"
    port: Annotated[Whole, Field(ge=0, le=65535)] = 8321
    data_directory: Annotated[str, Field(min_length=1)] = Field(default_factory=state_directory)
    upload_limit_bytes: Annotated[Whole, Field(gt=0)] = 32 * 1024 * 1024
    names: tuple[Annotated[str, Field(min_length=1)], ...] = ()
    proxies: tuple[Annotated[str, AfterValidator(_network)], ...] = ()
    certificate: str | None = None
    private_key: str | None = None
    requests_per_s: Positive = 100.0
    connections_limit: Annotated[Whole, Field(gt=0)] = 256
    log: Literal["text", "json"] = "text"
    database_url: Annotated[str, Field(min_length=1)] | None = None
    keep_tunings: Annotated[Whole, Field(gt=0)] = 2000
    keep_bytes: Annotated[Whole, Field(gt=0)] = 4 * 1024**3
    real_time: Annotated[Whole, Field(ge=0, le=99)] = 0


class LearnedTable(Table):
    """`[learned]`: selection of trained corrections; by default those of the tuner."""

    artefacts: Annotated[str, Field(min_length=1)] | None = None


class Configuration(Table):
    """The whole file."""

    service: ServiceTable = Field(default_factory=ServiceTable)
    learned: LearnedTable = LearnedTable()
    loops: dict[str, LoopTable] = Field(min_length=1)

    def is_urgent(self, loop: LoopTable) -> bool:
        """Return whether a millisecond counts for a loop, and the service is in the real-time class."""
        return self.service.real_time > 0 and loop.sample_time_s <= FAST_S

    def listening_on(self, host: str | None, port: int | None) -> Configuration:
        """Return the same configuration with another address; None keeps that of the file."""
        return self._with_service(host=host, port=port)

    def keeping_state_in(self, data_directory: Path | None) -> Configuration:
        """Return the same configuration with another data directory; None keeps that of the file."""
        return self._with_service(data_directory=None if data_directory is None else str(data_directory))

    def _with_service(self, **values: object) -> Configuration:
        given = {name: value for name, value in values.items() if value is not None}
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
"""Default configuration: a simulated heater."""

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
        The file cannot be read, is not TOML, or a key is wrong; names the key, the value and the remedy.
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
    except (ValueError, RecursionError) as error:  # not TOML or UTF-8, a number without end, thousands of brackets
        raise ConfigurationError(
            f"is not valid TOML: {error}", field=str(file), remedy="Correct that place."
        ) from error
    return parse_configuration(values, str(file))


def parse_configuration(values: Mapping[str, object], source: str) -> Configuration:
    """Check the values of a configuration; errors prefix the key with `source`."""
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
    """Return the key of an experiment's setting in its loop's table."""
    return f"relay.{field}" if field.partition(".")[0] in RelayTable.model_fields else field
