"""The OPC UA driver: hand-worked values, the library's own server, and a PLC on node-opcua, which shares no code."""

import asyncio
import contextlib
import datetime
import math
import signal

import pytest

from autotuner.errors import ConfigurationError, DeviceRefusedError, DriverError, LinkError
from autotuner_drivers import options
from autotuner_drivers.opcua import create
from autotuner_drivers.opcua.nodes import raw_of, read_signals, value_of
from autotuner_drivers.options import Options
from autotuner_drivers.testing.conformance import Subject, run
from autotuner_drivers.testing.link import TcpLink

asyncua = pytest.importorskip("asyncua", reason="the extra opcua is not installed")
ua = asyncua.ua
NOW = datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
PLC = {
    "pv": "PV",
    "output": "OUT",
    "set_point": "SP",
    "auto": "MODE",
    "kp": "KP",
    "ti": "TI",
    "td": "TD",
    "fault": "FAULT",
}


def signal_of(name="pv", **keys):
    table = {"nodes": {"pv": {"node": "i=1"}, "output": {"node": "i=2"}} | {name: {"node": "i=3"} | keys}}
    return read_signals(Options(table))[name]


def data(value, status="Good", source=NOW, server=NOW):
    return ua.DataValue(
        ua.Variant(value),
        ua.StatusCode(getattr(ua.StatusCodes, status)),
        SourceTimestamp=source,
        ServerTimestamp=server,
    )


@pytest.mark.parametrize(
    ("keys", "answer", "value", "reason"),
    [
        ({"scale": 0.1, "offset": 5.0}, data(123), 17.3, ""),
        ({}, data(True), 1.0, ""),
        ({}, data(1.5, "Uncertain"), math.nan, "uncertain quality"),
        ({}, data(1.5, "BadSensorFailure"), math.nan, "BadSensorFailure"),
        ({}, data(1.5, "GoodClamped"), 1.5, ""),
        ({"max_age_s": 5.0}, data(1.5, source=NOW - datetime.timedelta(seconds=5)), 1.5, ""),
        ({"max_age_s": 5.0}, data(1.5, source=NOW - datetime.timedelta(seconds=6)), math.nan, "6.0 s old"),
        ({"max_age_s": 5.0}, data(1.5, source=None), 1.5, ""),
        ({}, data(None), math.nan, "no value"),
        ({}, data(math.inf), math.inf, ""),
    ],
)
def test_values_status_and_timestamps_by_hand(keys, answer, value, reason):
    seen, why = value_of(signal_of(**keys), answer)
    assert seen == pytest.approx(value, nan_ok=True)
    assert reason in why
    assert bool(why) == bool(reason)


def test_a_node_that_holds_no_number_is_refused():
    with pytest.raises(DeviceRefusedError, match="holds a str"):
        value_of(signal_of(), data("23.1"))


@pytest.mark.parametrize(
    ("kind", "keys", "value", "raw"),
    [
        ("Int16", {"scale": 0.1}, 40.04, 400),
        ("UInt16", {"scale": 0.1, "offset": -50.0}, -10.0, 400),
        ("Float", {}, 40.04, 40.04),
        ("Boolean", {}, 1.0, True),
        ("Double", {}, -1e300, -1e300),
    ],
)
def test_values_are_written_in_the_type_of_the_node(kind, keys, value, raw):
    written = raw_of(signal_of("output", **keys), kind, value)
    assert (written, type(written)) == (pytest.approx(raw), type(raw))


@pytest.mark.parametrize(("kind", "value"), [("Int16", 32768.0), ("Byte", -1.0), ("Float", 1e39), ("Boolean", 2.0)])
def test_a_value_that_does_not_fit_the_type_is_refused(kind, value):
    with pytest.raises(DeviceRefusedError):
        raw_of(signal_of("output"), kind, value)


def test_several_values_may_mean_automatic():
    mode = signal_of("auto", auto_value=[1, 3, 4], manual_value=0)
    assert [value_of(mode, data(raw))[0] for raw in (0, 1, 3, 4)] == [0.0, 1.0, 1.0, 1.0]
    assert (raw_of(mode, "Int16", 1.0), raw_of(mode, "Int16", 0.0)) == (1, 0)
    with pytest.raises(DeviceRefusedError, match="neither automatic"):
        value_of(mode, data(2))


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"endpoint": "http://plc"}, "endpoint"),
        ({"endpoint": "opc.tcp://a:secret@plc"}, "endpoint"),
        ({"nodes": {"pv": {"node": "i=1"}}}, "nodes.output"),
        ({"nodes": {"pv": {"node": "i=1", "scale": 0.0}, "output": {"node": "i=1"}}}, "nodes.pv.scale"),
        ({"nodes": {"pv": {"nod": "i=1"}, "output": {"node": "i=1"}}}, "nodes.pv.node"),
        ({"security": "Basic128"}, "security"),
        ({"security": "Basic256Sha256"}, "cert_file"),
        ({"user": "a", "password_env": "NOT_SET_ANYWHERE"}, "password_env"),
        ({"user": "a", "password_file": "/no/such/file"}, "password_file"),
    ],
)
def test_a_wrong_table_is_refused_with_its_key(change, field):
    nodes = {"pv": {"node": "i=1"}, "output": {"node": "i=2"}}
    with pytest.raises(ConfigurationError) as refusal:
        create({"endpoint": "opc.tcp://plc:4840", "nodes": nodes} | change)
    assert refusal.value.field == field
    assert "secret" not in str(refusal.value)


def test_without_the_library_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "asyncua", None)
    with pytest.raises(ConfigurationError, match=r'pip install "relay-autotuner\[opcua\]"'):
        options.import_extra("opcua", "asyncua")


@contextlib.asynccontextmanager
async def own_server(port, **values):
    """The library's own server with one writable node for each value; yields the nodes."""
    server = asyncua.Server()
    await server.init()
    server.set_endpoint(f"opc.tcp://127.0.0.1:{port}/")
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    index = await server.register_namespace("urn:plant")
    plant = await server.nodes.objects.add_object(index, "Plant")
    nodes = {
        name: await plant.add_variable(ua.NodeId(name, index), ua.QualifiedName(name, index), value)
        for name, value in values.items()
    }
    for node in nodes.values():
        await node.set_writable()
    async with server:
        yield server, nodes


@pytest.mark.realtime
async def test_browse_paths_and_data_types_on_the_librarys_server(free_port):
    initial = ua.Variant(400, ua.VariantType.Int16)
    async with own_server(free_port, PV=21.5, OUT=initial, MODE=False) as (_, nodes):
        backend = create(
            {
                "endpoint": f"opc.tcp://127.0.0.1:{free_port}/",
                "nodes": {
                    "pv": {"node": "2:Plant/2:PV"},
                    "output": {"node": "ns=2;s=OUT", "scale": 0.1},
                    "auto": {"node": "ns=2;s=MODE"},
                },
            }
        )
        await backend.open()
        assert await backend.read(["pv", "output", "auto"]) == {"pv": 21.5, "output": 40.0, "auto": 0.0}
        await backend.write({"auto": 1.0, "output": 55.57})
        held = await nodes["OUT"].read_data_value()
        assert (held.Value.Value, held.Value.VariantType) == (556, ua.VariantType.Int16)
        assert await nodes["MODE"].read_value() is True
        assert backend.limits("output") == pytest.approx((-3276.8, 3276.7))
        assert backend.resolution("output", 50.0) == pytest.approx(0.1)
        await backend.close()


@pytest.mark.realtime
@pytest.mark.parametrize("node", ["ns=2;s=NONE", "2:Plant/2:NONE"])
async def test_a_node_that_is_not_there_is_named(free_port, node):
    async with own_server(free_port, PV=21.5, OUT=1.0):
        nodes = {"pv": {"node": node}, "output": {"node": "ns=2;s=OUT"}}
        backend = create({"endpoint": f"opc.tcp://127.0.0.1:{free_port}/", "nodes": nodes})
        with pytest.raises(DeviceRefusedError, match=r"nodes\.pv: is not a node"):
            await backend.open()
        await backend.close()


def plc_options(peer, **changes):
    nodes = {name: {"node": f"ns={peer['namespace']};s={node}"} for name, node in PLC.items()}
    return {"endpoint": peer["endpoint"], "timeout_s": 2.0, "nodes": nodes} | changes


@pytest.fixture
def plc(node_peer, free_port):
    return node_peer("opcua_plc.js", "node-opcua", free_port, 2, 2, 0.3)


@pytest.mark.realtime
async def test_the_driver_conforms_on_node_opcua(plc, free_port):
    absent = plc_options(plc, endpoint="opc.tcp://127.0.0.1:1")
    link = TcpLink("127.0.0.1", free_port)
    await link.start()
    here = plc_options(plc, endpoint=f"opc.tcp://127.0.0.1:{link.port}/plc")
    outcomes = await run(Subject(lambda: create(here), 0.0, 100.0, 5.0, unreachable=lambda: create(absent), link=link))
    await link.close()
    assert [o for o in outcomes if o.passed is not True] == []


@pytest.mark.realtime
async def test_quality_and_stale_timestamps_of_node_opcua(plc, caplog):
    options = plc_options(plc)
    options["nodes"]["pv"]["max_age_s"] = 0.2
    backend = create(options)
    await backend.open()
    seen = {}
    for fault in (1, 2, 0, 3, 0):
        await backend.write({"fault": fault})
        await asyncio.sleep(0.3)
        seen[fault] = (await backend.read(["pv"]))["pv"]
    await backend.close()
    assert [math.isnan(seen[fault]) for fault in (0, 1, 2, 3)] == [False, True, True, True]
    assert "UncertainSensorNotAccurate" in caplog.text
    assert "BadSensorFailure" in caplog.text
    assert "its source timestamp is 0." in caplog.text


@pytest.mark.realtime
async def test_the_mode_by_methods(plc):
    options, ns = plc_options(plc), plc["namespace"]
    options["nodes"]["auto"] = {
        "node": f"ns={ns};s=MODE_RO",
        "auto_call": {"object": f"ns={ns};s=TIC101", "method": f"ns={ns};s=SetAuto"},
        "manual_call": {"object": f"ns={ns};s=TIC101", "method": f"ns={ns};s=SetManual"},
    }
    backend = create(options)
    await backend.open()
    for mode in (1.0, 0.0):
        await backend.write({"auto": mode})
        assert await backend.read(["auto"]) == {"auto": mode}
    await backend.close()


@pytest.mark.realtime
async def test_a_node_that_cannot_be_written_is_refused_with_its_status(plc):
    options = plc_options(plc)
    options["nodes"]["kp"] = {"node": f"ns={plc['namespace']};s=PV"}
    backend = create(options)
    await backend.open()
    with pytest.raises(DeviceRefusedError, match="BadNotWritable"):
        await backend.write({"kp": 1.0})
    assert set(await backend.read(["pv"])) == {"pv"}
    await backend.close()


@pytest.mark.realtime
async def test_a_server_that_is_stopped_and_continued(plc):
    backend = create(plc_options(plc, timeout_s=0.5))
    await backend.open()
    plc["process"].send_signal(signal.SIGSTOP)
    with pytest.raises(LinkError):
        await backend.read(["pv"])
    plc["process"].send_signal(signal.SIGCONT)
    async with asyncio.timeout(10.0):
        while True:
            with contextlib.suppress(DriverError):
                await backend.read(["pv"])
                break
            await asyncio.sleep(0.1)
    await backend.close()


@pytest.mark.realtime
async def test_a_server_that_dies_is_a_lost_link(plc):
    backend, reasons = create(plc_options(plc)), []
    await backend.open()
    backend.watch(reasons.append)
    plc["process"].kill()
    plc["process"].wait(5.0)
    with pytest.raises(LinkError):
        await backend.read(["pv"])
    await backend.close()


@pytest.mark.realtime
async def test_a_login_is_needed_and_taken(node_peer, free_port, tmp_path):
    peer = node_peer("opcua_plc.js", "node-opcua", free_port, 2, 2, 0.3, "tuner", "open sesame")
    (tmp_path / "word").write_text("open sesame\n", encoding="utf-8")
    backend = create(plc_options(peer, user="tuner", password_file=str(tmp_path / "word")))
    await backend.open()
    assert set(await backend.read(["pv"])) == {"pv"}
    await backend.close()
    (tmp_path / "word").write_text("open barley\n", encoding="utf-8")
    backend = create(plc_options(peer, user="tuner", password_file=str(tmp_path / "word")))
    with pytest.raises(DriverError) as refusal:
        await backend.open()
    await backend.close()
    assert "barley" not in str(refusal.value)
    assert "user and password" in refusal.value.remedy


@pytest.mark.realtime
async def test_a_signed_and_encrypted_connection(plc, tmp_path):
    from asyncua.crypto.cert_gen import setup_self_signed_certificate
    from cryptography.x509.oid import ExtendedKeyUsageOID

    uri = "urn:relay-autotuner:test"
    cert, key = tmp_path / "client.der", tmp_path / "client.pem"
    await setup_self_signed_certificate(key, cert, uri, "localhost", [ExtendedKeyUsageOID.CLIENT_AUTH], {})
    backend = create(
        plc_options(
            plc, timeout_s=5.0, security="Basic256Sha256", cert_file=str(cert), key_file=str(key), application_uri=uri
        )
    )
    await backend.open()
    assert set(await backend.read(["pv"])) == {"pv"}
    await backend.close()
