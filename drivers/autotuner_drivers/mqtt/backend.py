"""Driver `mqtt`: a device that talks through an MQTT broker (extra `mqtt`, package aiomqtt).

Options (table ``[loops.NAME.device]``), with their defaults::

    host = "192.168.1.5"             # broker; required
    port = 1883                      # 8883 with tls
    interval_s = 10.0                # required: longest time between two reports of the PV
    timeout_s = 5.0                  # longest wait for the broker, and for the device to confirm a command
    tls = false
    ca_file = "ca.pem"               # certificate authority; default those of the system
    cert_file = "client.pem"         # our own certificate and key
    key_file = "client.key"
    user = "tuner"                   # login; default none
    password_file = "/run/secrets/mqtt"          # or password_env
    password_env = "MQTT_PASSWORD"
    client_id = "autotuner-TIC"      # default: a new one at each start
    keep_alive_s = 10.0              # the broker publishes our last will after 1.5 times this silence

    [loops.NAME.device.topics]       # pv and output are required
    pv = { topic = "tele/boiler/SENSOR", json = "DS18B20.Temperature" }
    output = { topic = "stat/boiler/RESULT", json = "Dimmer", command = "cmnd/boiler/Dimmer", payload = "{value:.0f}" }
    auto = { topic = "boiler/mode", command = "boiler/mode/set", auto_value = ["heat", "auto"], manual_value = "off" }

    [loops.NAME.device.availability]             # the device's last will; default none
    topic = "tele/boiler/LWT"
    online = "Online"
    offline = "Offline"

    [loops.NAME.device.will]         # last will of the tuner, for an automation that resets the output
    topic = "autotuner/boiler"
    online = "online"
    offline = "offline"

A signal has `topic` (reported by the device; `json`: path into the payload), `command` (sets it; `payload`, `retain`),
`request` and `request_payload` (asks for a report), `scale`, `offset`, `tolerance`.

Invariants:

1. A PV counts only when it arrives: a retained message may be days old and is ignored. A sample carries the time of its
arrival; a PV that is reported on change holds until `interval_s` after the last report, then it is NaN.
2. Signals other than the PV may be retained, because a device reports its state in this way.
3. A command is complete when the device reports the value; without a `topic`, when the broker acknowledges it.
4. A command is not retained unless `retain` is set: a broker would repeat the relay's last level at every start of
the device.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import uuid
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from autotuner.errors import DeviceRefusedError, DeviceTimeoutError, DriverError, LinkError
from autotuner.ports import PV
from autotuner_drivers.links import CHECK_LINE
from autotuner_drivers.mqtt.topics import read_signals, value_of
from autotuner_drivers.options import Login, Options, import_extra, read_login, read_tls
from autotuner_drivers.remote import RemoteBackend

if TYPE_CHECKING:
    import ssl
    from collections.abc import Callable, Mapping, Sequence

    from autotuner_drivers.mqtt.topics import TopicSignal

AT_LEAST_ONCE: Final = 1
"""Quality of service of all subscriptions and commands."""
REFUSED_LOGIN: Final = frozenset({4, 5, 134, 135})
"""Reason codes of a broker that rejects the user (MQTT 3.1.1 and 5)."""
_log = logging.getLogger("autotuner.drivers.mqtt")


@dataclass(frozen=True, slots=True)
class Presence:
    """Topic that announces whether a client is online, and its two payloads."""

    topic: str
    online: str
    offline: str


@dataclass(frozen=True, slots=True)
class Broker:
    """Address and login of a broker."""

    host: str
    port: int
    client_id: str
    keep_alive_s: float
    login: Login | None
    tls: ssl.SSLContext | None


@dataclass(frozen=True, slots=True)
class Report:
    """Report of a device: the value, its arrival on the event loop's clock, s, and whether the message was retained."""

    value: float
    at_s: float
    retained: bool


class MqttTransport:
    """The topics of one loop.

    Parameters
    ----------
    broker : Broker
        The broker.
    signals : dict
        Topics by signal.
    interval_s : float
        Longest time between two reports of the PV, s.
    timeout_s : float
        Longest wait for the broker, or for the device to confirm a command, s.
    availability, will : Presence, optional
        The device's last will, and ours.
    """

    def __init__(
        self,
        broker: Broker,
        signals: dict[str, TopicSignal],
        interval_s: float,
        timeout_s: float,
        *,
        availability: Presence | None,
        will: Presence | None,
    ) -> None:
        self.label = f"{broker.host}:{broker.port} topic {signals[PV].topic}"
        self.readable = frozenset(name for name, signal in signals.items() if signal.topic)
        self.writable = frozenset(name for name, signal in signals.items() if signal.command) - {PV}
        self.gone: Callable[[str], None] | None = None
        self.moment_s = math.nan
        self._broker, self._signals = broker, signals
        self._interval_s, self._timeout_s = interval_s, timeout_s
        self._availability, self._will = availability, will
        self._library = import_extra("mqtt", "aiomqtt")
        self._client: Any = None
        self._listener: asyncio.Task[None] | None = None
        self._reports: dict[str, Report] = {}
        self._reasons: dict[str, str] = {}
        self._lost: Exception | None = None
        self._away = False
        self._news = asyncio.Event()

    async def connect(self) -> None:
        """Connect, subscribe, and wait for a PV that is not retained."""
        self._reports, self._lost, self._away = {}, None, False
        async with asyncio.timeout(self._timeout_s):
            await self._connect()
        await self._await_message(PV, self._interval_s)

    async def read(self, names: Sequence[str]) -> dict[str, float]:
        """Return the last reports; wait for a signal that was never reported."""
        self._check()
        for name in names:
            if name not in self._reports:
                await self._await_message(name, self._timeout_s)
        return {name: self._pv() if name == PV else self._reports[name].value for name in names}

    async def write(self, name: str, value: float) -> None:
        """Publish the command, and wait until the device reports the value."""
        self._check()
        signal = self._signals[name]
        clock = asyncio.get_running_loop().time
        previous, started_s = self._reports.get(name), clock()
        await self._publish(signal.command, signal.text(value), retain=signal.retain)
        self.moment_s = (started_s + clock()) / 2.0
        if not signal.topic or (previous is not None and signal.confirms(previous.value, value)):
            return
        while not (
            (report := self._reports.get(name)) and report is not previous and signal.confirms(report.value, value)
        ):
            await self._confirmation(signal, value, started_s + self._timeout_s)

    async def disconnect(self, *, lost: bool) -> None:
        """Publish the offline payload of our will, and disconnect."""
        listener, self._listener = self._listener, None
        client, self._client = self._client, None
        if client is not None and not lost and self._will is not None:
            with contextlib.suppress(Exception):
                await client.publish(self._will.topic, self._will.offline, qos=AT_LEAST_ONCE, retain=True)
        if listener is not None:
            listener.cancel()
            await asyncio.gather(listener, return_exceptions=True)
        if client is not None:
            with contextlib.suppress(Exception):
                await client.__aexit__(None, None, None)

    def error(self, error: Exception) -> DriverError | None:
        """Map an exception of the library to an error of the port."""
        if not isinstance(error, self._library.MqttError):
            return None
        code = getattr(error, "rc", None)
        if getattr(code, "value", code) in REFUSED_LOGIN:
            return LinkError(f"{self.label}: the broker refused the login: {error}", remedy="Check user and password.")
        return LinkError(f"{self.label}: {error}", remedy=CHECK_LINE)

    def limits(self, name: str) -> tuple[float, float]:  # noqa: ARG002 - a topic accepts any number
        """Return no limits."""
        return -math.inf, math.inf

    def resolution(self, name: str, value: float) -> float:  # noqa: ARG002 - the payload fixes it
        """Return the step of the values that are sent."""
        return self._signals[name].step

    async def _connect(self) -> None:
        will, login = self._will, self._broker.login
        client = self._library.Client(
            self._broker.host,
            self._broker.port,
            identifier=self._broker.client_id or f"autotuner-{uuid.uuid4().hex[:12]}",
            username=login.user if login else None,
            password=login.password if login else None,
            keepalive=max(round(self._broker.keep_alive_s), 1),
            timeout=self._timeout_s,
            tls_context=self._broker.tls,
            will=self._library.Will(will.topic, will.offline, AT_LEAST_ONCE, retain=True) if will else None,
        )
        await client.__aenter__()
        self._client = client
        self._listener = asyncio.ensure_future(self._listen(client))
        topics = {signal.topic for signal in self._signals.values() if signal.topic}
        if self._availability is not None:
            topics.add(self._availability.topic)
        await client.subscribe([(topic, AT_LEAST_ONCE) for topic in sorted(topics)])
        if will is not None:
            await self._publish(will.topic, will.online, retain=True)
        for signal in self._signals.values():
            if signal.request is not None:
                await self._publish(*signal.request, retain=False)

    async def _publish(self, topic: str, payload: str, *, retain: bool) -> None:
        await self._client.publish(topic, payload, qos=AT_LEAST_ONCE, retain=retain, timeout=self._timeout_s)

    async def _listen(self, client: Any) -> None:
        try:
            async for message in client.messages:
                self._take(message.topic.value, bytes(message.payload or b""), retained=bool(message.retain))
        except self._library.MqttError as error:
            self._lost = error
            if self.gone is not None:
                self.gone(f"{self.label}: {error}")
        finally:
            self._news.set()

    def _take(self, topic: str, payload: bytes, *, retained: bool) -> None:
        if self._availability is not None and topic == self._availability.topic:
            self._away = payload.decode(errors="replace").strip() == self._availability.offline
            if self._away and not retained and self.gone is not None:
                self.gone(f"the device reports {self._availability.offline!r} on {topic}")
        now_s = asyncio.get_running_loop().time()
        for name, signal in self._signals.items():
            if signal.topic == topic and not (retained and name == PV):
                self._take_report(signal, payload, now_s, retained=retained)
        self._news.set()

    def _take_report(self, signal: TopicSignal, payload: bytes, now_s: float, *, retained: bool) -> None:
        """Store a report; a payload without the value, as on a shared topic, leaves the signal unchanged."""
        value, reason = value_of(signal, payload)
        if math.isnan(value) and (signal.name != PV or "has no" in reason):
            return
        self._reports[signal.name] = Report(value, now_s, retained)
        self._note(signal.name, reason)

    def _pv(self) -> float:
        """Return the PV, or NaN after a silence, and set the time of the sample."""
        report, now_s = self._reports[PV], asyncio.get_running_loop().time()
        silent_s = now_s - report.at_s
        if silent_s > self._interval_s:
            self._note(PV, f"nothing was reported for {self._interval_s:g} s")
            self.moment_s = now_s
            return math.nan
        last_s = -math.inf if math.isnan(self.moment_s) else self.moment_s
        self.moment_s = report.at_s if report.at_s > last_s else now_s  # no report since: the value still holds
        return report.value

    async def _await_message(self, name: str, wait_s: float) -> None:
        """Wait for the first report of a signal."""
        try:
            async with asyncio.timeout(wait_s):
                while name not in self._reports:
                    await self._something()
        except TimeoutError as error:
            raise DeviceTimeoutError(
                f"no report arrived on {self._signals[name].topic} within {wait_s:g} s",
                remedy="Check the topic and the JSON path, that the device is on, and interval_s; a retained PV does "
                "not count.",
            ) from error

    async def _confirmation(self, signal: TopicSignal, value: float, deadline_s: float) -> None:
        """Wait for the next message; raise when the device has not confirmed a command in time."""
        try:
            async with asyncio.timeout_at(deadline_s):
                await self._something()
        except TimeoutError as error:
            report = self._reports.get(signal.name)
            raise DeviceRefusedError(
                f"was set to {value:g} on {signal.command}, but the device "
                + (f"reports {report.value:g}" if report else "reports nothing"),
                field=signal.name,
                value=value,
                remedy="Check command, payload and topic, the device's limits and its mode.",
            ) from error

    async def _something(self) -> None:
        """Wait for a message; raise when the connection is lost or the device is offline."""
        self._news.clear()
        self._check()
        await self._news.wait()
        self._check()

    def _check(self) -> None:
        if self._lost is not None:
            raise self._lost
        if self._away and self._availability is not None:
            raise LinkError(
                f"the device reports {self._availability.offline!r} on {self._availability.topic}",
                remedy="Check the device's power and its network.",
            )

    def _note(self, name: str, reason: str) -> None:
        if reason != self._reasons.get(name, ""):
            self._reasons[name] = reason
            _log.warning("%s: %s (%s)", name, reason or "reports again", self.label)


def create(options: Mapping[str, object]) -> RemoteBackend:
    """Return a closed backend for the options of a loop's device.

    Raises
    ------
    ConfigurationError
        Names the key, the value and the remedy; nothing has been sent.
    """
    table = Options(options)
    host = table.text("host")
    tls = read_tls(table) if table.flag("tls", default=False) else None
    broker = Broker(
        host,
        table.integer("port", 8883 if tls else 1883, low=1, high=65535),
        table.text("client_id") if "client_id" in table else "",
        table.number("keep_alive_s", 10.0, low=1.0, high=3600.0, unit="s"),
        read_login(table),
        tls,
    )
    signals = read_signals(table)
    interval_s = table.number("interval_s", low=0.01, high=86400.0, unit="s")
    timeout_s = table.number("timeout_s", 5.0, low=0.05, high=3600.0, unit="s")
    presences = {key: _read_presence(table.table(key)) if key in table else None for key in ("availability", "will")}
    table.done()
    transport = MqttTransport(broker, signals, interval_s, timeout_s, **presences)
    return RemoteBackend(transport, 2.0 * timeout_s + interval_s)


def _read_presence(table: Options) -> Presence:
    presence = Presence(table.text("topic"), table.text("online", "online"), table.text("offline", "offline"))
    table.done()
    return presence
