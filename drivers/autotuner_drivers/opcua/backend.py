"""Driver `opcua`: a loop of nodes of an OPC UA server (extra `opcua`, package asyncua).

Options (table ``[loops.NAME.device]``), with their defaults::

    endpoint = "opc.tcp://192.168.1.20:4840"     # required
    timeout_s = 4.0                  # longest wait for a connection, and for an answer
    security = "none"                # or Basic256Sha256, Aes128Sha256RsaOaep, Aes256Sha256RsaPss
    security_mode = "sign_and_encrypt"           # or sign
    cert_file = "client.der"         # our certificate and key; required with `security`
    key_file = "client.pem"
    server_cert_file = "server.der"  # the server's certificate; default: any certificate is accepted
    application_uri = "urn:..."      # as in our certificate; default that of the library
    user = "tuner"                   # login; default anonymous
    password_file = "/run/secrets/tuner"         # or password_env; the configuration never contains the password
    password_env = "TUNER_PASSWORD"

    [loops.NAME.device.nodes]        # pv and output are required
    pv = { node = "ns=2;s=TIC101.PV", max_age_s = 5.0 }
    output = { node = "ns=2;s=TIC101.OUT", write_node = "ns=2;s=TIC101.MAN", scale = 0.1 }
    set_point = { node = "2:Plant/2:TIC101/2:SP" }           # a browse path below Objects
    auto = { node = "ns=2;s=TIC101.MODE", auto_value = [1, 3], manual_value = 0 }

`scale`, `offset` as in all drivers. `auto_value` and `manual_value` may be lists: all values are recognised, the first
is written. A device that changes its mode by a method has ``auto_call = { object = "ns=2;s=TIC101", method =
"ns=2;s=TIC101.SetAuto", arguments = [] }`` and `manual_call`; any other signal `call`, whose arguments may contain
``"{value}"``. Values are written in the node's own data type, without timestamps.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlparse

from autotuner.errors import DeviceRefusedError, DeviceTimeoutError, DriverError, LinkError
from autotuner.ports import PV
from autotuner_drivers.links import CHECK_LINE
from autotuner_drivers.opcua.nodes import FLOATS, NodeSignal, is_identifier, raw_limits, raw_of, read_signals, value_of
from autotuner_drivers.options import Login, Options, import_extra, read_login, refuse
from autotuner_drivers.remote import RemoteBackend

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from datetime import datetime

    from autotuner_drivers.opcua.nodes import Call

POLICIES: Final = ("none", "Basic256Sha256", "Aes128Sha256RsaOaep", "Aes256Sha256RsaPss")
"""Security policies that are not deprecated (OPC 10000-7); `none` neither signs nor encrypts."""
SESSION_S: Final = 60.0
"""Session timeout requested from the server, s: the server closes a session that is silent for longer."""
WATCHDOG_S: Final = SESSION_S / 3.0
"""Period at which the library reads the server's state, s, which keeps the session of an idle loop alive."""

LOST: Final = frozenset(
    {
        "BadCommunicationError",
        "BadConnectionClosed",
        "BadNotConnected",
        "BadSecureChannelClosed",
        "BadSecureChannelIdInvalid",
        "BadSecureChannelTokenUnknown",
        "BadServerHalted",
        "BadServerNotConnected",
        "BadSessionClosed",
        "BadSessionIdInvalid",
        "BadSessionNotActivated",
        "BadShutdown",
    }
)
"""Status codes after which a new connection is needed."""
REMEDIES: Final = {
    "BadNodeIdUnknown": "Check the node identifier; `autotuner probe opc.tcp://...` lists the nodes.",
    "BadNoMatch": "Check the browse path: each name needs its namespace, as in 2:Plant/2:TIC101.",
    "BadNotWritable": "The server does not let this node be written: use another node, or change its access level.",
    "BadUserAccessDenied": "Check user and password, and whether this user may connect and write the node.",
    "BadTypeMismatch": "The node does not take its own data type: set the value by a method, see `call`.",
    "BadOutOfRange": "Set the loop's limits within the range of the node.",
    "BadIdentityTokenRejected": "Check user and password, and whether the server takes passwords at this endpoint.",
    "BadIdentityTokenInvalid": "Check user and password, and whether the server takes passwords at this endpoint.",
    "BadSecurityChecksFailed": "Let the server trust our certificate, and check application_uri.",
    "BadCertificateUntrusted": "Let the server trust our certificate.",
    "BadCertificateUriInvalid": "Set application_uri to the URI in our certificate.",
}
ANY_REMEDY: Final = "Look the status code up in the server's manual."
_log = logging.getLogger("autotuner.drivers.opcua")
_library_log = logging.getLogger("asyncua")  # duplicates the errors of this driver
_library_log.addHandler(logging.NullHandler())
_library_log.propagate = False


@dataclass(frozen=True, slots=True)
class Security:
    """Policy, mode and certificates of a connection."""

    policy: str
    mode: str
    cert_file: str
    key_file: str
    server_cert_file: str
    application_uri: str


class OpcUaTransport:
    """The nodes of one loop.

    Parameters
    ----------
    endpoint : str
        Address of the server.
    signals : dict
        Nodes by signal.
    timeout_s : float
        Longest wait for an answer, s.
    security : Security, optional
        How the connection is secured; None for not at all.
    login : Login, optional
        User and password; None for anonymous.
    """

    def __init__(
        self,
        endpoint: str,
        signals: dict[str, NodeSignal],
        timeout_s: float,
        security: Security | None,
        login: Login | None,
    ) -> None:
        self.label = f"{endpoint}"
        self.readable = frozenset(signals)
        self.writable = frozenset(signals) - {PV}
        self.gone: Callable[[str], None] | None = None
        self._endpoint, self._signals, self._timeout_s = endpoint, signals, timeout_s
        self._security, self._login = security, login
        self._library = import_extra("opcua", "asyncua")
        self._client: Any = None
        self._ids: dict[str, Any] = {}
        self._types: dict[str, Any] = {}
        self._reasons: dict[str, str] = {}
        self._sources: dict[str, tuple[datetime | None, float]] = {}

    async def connect(self) -> None:
        """Connect, and resolve the nodes and their data types."""
        self._sources = {}
        client = self._client = self._library.Client(self._endpoint, self._timeout_s, WATCHDOG_S)
        client.session_timeout = int(1000.0 * SESSION_S)
        client.connection_lost_callback = self._lost
        if self._login is not None:
            client.set_user(self._login.user)
            client.set_password(self._login.password)
        if self._security is not None:
            await _secure(client, self._security)
        await client.connect()
        self._ids = {}
        for signal in self._signals.values():
            for node in {signal.node, signal.write_node}:
                self._ids[node] = await self._found(signal, node)
        self._types = await self._data_types()

    async def read(self, names: Sequence[str]) -> dict[str, float]:
        """Return the values of all nodes, read in one request."""
        ua = self._library.ua
        nodes = [self._ids[self._signals[name].node] for name in names]
        request = ua.ReadParameters(
            TimestampsToReturn=ua.TimestampsToReturn.Both,
            NodesToRead=[ua.ReadValueId(NodeId=node, AttributeId=ua.AttributeIds.Value) for node in nodes],
        )
        answers = await self._client.uaclient.read(request)
        return {name: self._value(self._signals[name], data) for name, data in zip(names, answers, strict=True)}

    async def write(self, name: str, value: float) -> None:
        """Write the node in its own data type, or call the method that sets the signal."""
        ua, signal = self._library.ua, self._signals[name]
        if (call := signal.call(value)) is not None:
            await self._call(signal, call, value)
            return
        kind = self._types[name]
        data = ua.DataValue(ua.Variant(raw_of(signal, kind.name, value), kind))
        (status,) = await self._client.uaclient.write_attributes(
            [self._ids[signal.write_node]], [data], ua.AttributeIds.Value
        )
        status.check()

    async def disconnect(self, *, lost: bool) -> None:
        """Close session and connection; of a lost connection only the local end."""
        client, self._client = self._client, None
        if client is None:
            return
        client.connection_lost_callback = None
        if lost:
            client.disconnect_socket()
        with contextlib.suppress(Exception):
            await client.disconnect()

    def error(self, error: Exception) -> DriverError | None:
        """Map a status code or an exception of the library to an error of the port."""
        if isinstance(error, self._library.ua.UaStatusCodeError):
            code = self._library.ua.StatusCode(error.code)
            kind = LinkError if code.name in LOST else DeviceRefusedError
            kind = DeviceTimeoutError if code.name == "BadTimeout" else kind
            return kind(f"{self.label} answered {code.name} ({code.doc})", remedy=REMEDIES.get(code.name, ANY_REMEDY))
        if isinstance(error, self._library.ua.UaError):
            return LinkError(f"{self.label} cannot be used: {error}", remedy=CHECK_LINE)
        if isinstance(error, asyncio.IncompleteReadError | ConnectionError):
            return LinkError(f"{self.label} closed the connection, or refused it: {error}", remedy=CHECK_LINE)
        return None

    def limits(self, name: str) -> tuple[float, float]:
        """Return the range of the data type, once connected."""
        kind = self._types.get(name)
        return self._signals[name].scaling.limits(*raw_limits(kind.name)) if kind else (-math.inf, math.inf)

    def resolution(self, name: str, value: float) -> float:
        """Return the step of the data type, once connected."""
        kind = self._types.get(name)
        return self._signals[name].scaling.resolution(FLOATS.get(kind.name, ""), value) if kind else 0.0

    async def _found(self, signal: NodeSignal, node: str) -> Any:
        """Return the identifier of a node."""
        ua = self._library.ua
        try:
            if is_identifier(node):
                return ua.NodeId.from_string(node)
            return (await self._client.nodes.objects.get_child(node.split("/"))).nodeid
        except ua.UaError as error:
            code = type(error).__name__
            raise DeviceRefusedError(
                f"is not a node of {self.label}: {code}",
                field=f"nodes.{signal.name}",
                value=node,
                remedy=REMEDIES.get(code, "Check the node."),
            ) from error

    async def _data_types(self) -> dict[str, Any]:
        """Return the data type of each signal's written node: that of its value, or the declared one."""
        ua = self._library.ua
        nodes = [self._ids[signal.write_node] for signal in self._signals.values()]
        answers = await self._client.uaclient.read_attributes(nodes, ua.AttributeIds.Value)
        declared = await self._client.uaclient.read_attributes(nodes, ua.AttributeIds.DataType)
        types = {}
        for signal, data, kind in zip(self._signals.values(), answers, declared, strict=True):
            if data.StatusCode is not None and data.StatusCode.name == "BadNodeIdUnknown":
                raise DeviceRefusedError(
                    f"is not a node of {self.label}",
                    field=f"nodes.{signal.name}",
                    value=signal.write_node,
                    remedy=REMEDIES["BadNodeIdUnknown"],
                )
            held = data.Value.VariantType if data.Value is not None else ua.VariantType.Null
            types[signal.name] = _declared(ua, kind) if held == ua.VariantType.Null else held
        return types

    def _value(self, signal: NodeSignal, data: Any) -> float:
        """Return a value; log the reason for NaN once."""
        value, reason = value_of(signal, data, self._unchanged_s(signal.name, data.SourceTimestamp))
        if reason != self._reasons.get(signal.name, ""):
            self._reasons[signal.name] = reason
            _log.warning("%s: %s of %s", signal.name, reason or "good quality again", self.label)
        return value

    def _unchanged_s(self, name: str, source: datetime | None) -> float:
        """Return how long a source timestamp has been unchanged, s; 0 without a timestamp."""
        now_s = asyncio.get_running_loop().time()
        if self._sources.get(name, (None, 0.0))[0] != source:
            self._sources[name] = (source, now_s)
        return 0.0 if source is None else now_s - self._sources[name][1]

    async def _call(self, signal: NodeSignal, call: Call, value: float) -> None:
        ua = self._library.ua
        method = self._client.get_node(call.method)
        raw = signal.scaling.raw(value)
        types = await _argument_types(ua, method, len(call.arguments)) if call.arguments else []
        arguments = [
            ua.Variant(_cast(ua, kind, raw if argument == "{value}" else argument), kind)
            for argument, kind in zip(call.arguments, types, strict=True)
        ]
        await self._client.get_node(call.owner).call_method(ua.NodeId.from_string(call.method), *arguments)

    async def _lost(self, error: Exception) -> None:
        if self.gone is not None:
            self.gone(f"{self.label} closed the connection: {error}")


async def _secure(client: Any, security: Security) -> None:
    policies, ua = import_extra("opcua", "asyncua.crypto.security_policies"), import_extra("opcua", "asyncua").ua
    client.application_uri = security.application_uri or client.application_uri
    mode = ua.MessageSecurityMode.Sign if security.mode == "sign" else ua.MessageSecurityMode.SignAndEncrypt
    await client.set_security(
        getattr(policies, f"SecurityPolicy{security.policy}"),
        security.cert_file,
        security.key_file,
        server_certificate=security.server_cert_file or None,
        mode=mode,
    )


def _declared(ua: Any, data: Any) -> Any:
    """Return the variant type of a node without a value by its declared data type; Double when there is none."""
    try:
        return ua.VariantType(data.Value.Value.Identifier)
    except (AttributeError, ValueError):
        return ua.VariantType.Double


async def _argument_types(ua: Any, method: Any, count: int) -> list[Any]:
    """Return the variant types of a method's input arguments."""
    declared = await (await method.get_child("0:InputArguments")).read_value()
    if len(declared) != count:
        raise DeviceRefusedError(
            f"is a method with {len(declared)} arguments",
            field="arguments",
            value=count,
            remedy="Give as many arguments as the method has.",
        )
    return [ua.VariantType(argument.DataType.Identifier) for argument in declared]


def _cast(ua: Any, kind: Any, value: Any) -> Any:
    """Return a value of the Python type that belongs to a variant type."""
    if kind == ua.VariantType.Boolean:
        return bool(value)
    if kind == ua.VariantType.String:
        return str(value)
    return float(value) if kind.name in FLOATS else round(float(value))


def create(options: Mapping[str, object]) -> RemoteBackend:
    """Return a closed backend for the options of a loop's device.

    Raises
    ------
    ConfigurationError
        Names the key, the value and the remedy; nothing has been sent.
    """
    table = Options(options)
    endpoint = table.text("endpoint")
    address = urlparse(endpoint)
    if address.scheme != "opc.tcp" or not address.hostname or address.password:
        refuse(
            table.key("endpoint"),
            None,
            "must be an opc.tcp address",
            'Write "opc.tcp://host:4840"; see user for a login.',
        )
    signals = read_signals(table)
    timeout_s = table.number("timeout_s", 4.0, low=0.05, high=60.0, unit="s")
    transport = OpcUaTransport(endpoint, signals, timeout_s, _read_security(table), read_login(table))
    table.done()
    return RemoteBackend(transport, timeout_s)


def _read_security(table: Options) -> Security | None:
    policy = table.choice("security", POLICIES, POLICIES[0])
    if policy == "none":
        return None
    files = {key: table.text(key) for key in ("cert_file", "key_file")}
    files["server_cert_file"] = table.text("server_cert_file") if "server_cert_file" in table else ""
    for key, file in files.items():
        if file and not Path(file).is_file():
            refuse(table.key(key), file, "is not a file", "Give the path of a certificate or key, DER or PEM.")
    return Security(
        policy,
        table.choice("security_mode", ("sign_and_encrypt", "sign"), "sign_and_encrypt"),
        application_uri=table.text("application_uri") if "application_uri" in table else "",
        **files,
    )
