"""Modbus within TLS: the standard library's TLS in front of pyModbusTCP's server."""

import asyncio
import contextlib
import ssl
import threading

import pytest
from pyModbusTCP.server import DataBank, ModbusServer

from autotuner.errors import ConfigurationError, LinkError
from autotuner_drivers.modbus.backend import create
from tests.control.processes import ANSWER_S

pytestmark = pytest.mark.realtime

REGISTERS = {"pv": {"table": "input", "address": 0, "scale": 0.1}, "output": {"table": "holding", "address": 0}}


@pytest.fixture
def modbus_server():
    """A pyModbusTCP server with a PV of 21.5: its bank and port."""
    before, data = set(threading.enumerate()), DataBank(i_regs_size=10, h_regs_size=10)
    data.set_input_registers(0, [215])
    server = ModbusServer("127.0.0.1", 0, no_block=True, data_bank=data)
    server.start()
    yield data, server._service.server_address[1]
    server.stop()
    for thread in set(threading.enumerate()) - before:
        thread.join(5.0)


@contextlib.asynccontextmanager
async def tls_in_front(port, certificate, *, ask_for_client=False):
    """Take TLS off and pass the bytes on to `port`; yield the port in front."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*certificate)
    if ask_for_client:
        context.verify_mode = ssl.CERT_REQUIRED
        context.load_verify_locations(certificate[0])
    tasks = set()

    async def pump(reader, writer):
        with contextlib.suppress(ConnectionError, ssl.SSLError, asyncio.CancelledError):
            while piece := await reader.read(4096):
                writer.write(piece)
        writer.close()
        with contextlib.suppress(ConnectionError, ssl.SSLError, asyncio.CancelledError):
            await writer.wait_closed()

    async def join(reader, writer):
        far_reader, far_writer = await asyncio.open_connection("127.0.0.1", port)
        tasks.update({asyncio.create_task(pump(reader, far_writer)), asyncio.create_task(pump(far_reader, writer))})

    server = await asyncio.start_server(join, "127.0.0.1", 0, ssl=context)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
        _, pending = await asyncio.wait(tasks, timeout=2.0) if tasks else ((), ())
        for task in pending:
            task.cancel()
        await asyncio.gather(*pending, return_exceptions=True)
        await asyncio.sleep(0.05)


def backend(port, **options):
    line = {"transport": "tls", "host": "127.0.0.1", "port": port, "timeout_s": ANSWER_S, "registers": REGISTERS}
    return create(line | options)


async def test_values_pass_when_the_certificate_is_trusted_and_named(certificate, modbus_server):
    data, port = modbus_server
    async with tls_in_front(port, certificate) as front:
        loop = backend(front, ca_file=str(certificate[0]), server_name="plc.test")
        await loop.open()
        assert (await loop.read(["pv"]))["pv"] == 21.5
        await loop.write({"output": 7.0})
        await loop.close()
    assert data.get_holding_registers(0, 1) == [7]


async def test_a_client_certificate_is_shown_when_asked_for(certificate, modbus_server):
    async with tls_in_front(modbus_server[1], certificate, ask_for_client=True) as front:
        cert_file, key_file = map(str, certificate)
        loop = backend(front, ca_file=cert_file, server_name="plc.test", cert_file=cert_file, key_file=key_file)
        await loop.open()
        assert (await loop.read(["pv"]))["pv"] == 21.5
        await loop.close()


@pytest.mark.parametrize("trust", ["nobody", "another name"])
async def test_a_device_that_cannot_prove_itself_is_not_talked_to(certificate, modbus_server, trust):
    options = {} if trust == "nobody" else {"ca_file": str(certificate[0])}
    async with tls_in_front(modbus_server[1], certificate) as front:
        with pytest.raises(LinkError, match="certificate") as refusal:
            await backend(front, **options).open()
    assert isinstance(refusal.value.__cause__, ssl.SSLCertVerificationError)


async def test_only_the_given_authority_is_trusted(certificate, another_certificate, modbus_server, monkeypatch):
    """Not those that the system trusts as well, of which one is enough to pass for the device."""
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate[0]))
    async with tls_in_front(modbus_server[1], certificate) as front:
        trusting = backend(front, server_name="plc.test")
        await trusting.open()
        await trusting.close()
        with pytest.raises(LinkError, match="certificate"):
            await backend(front, ca_file=str(another_certificate[0]), server_name="plc.test").open()


def test_files_that_cannot_be_loaded_are_named(tmp_path):
    broken = tmp_path / "broken.pem"
    broken.write_text("no certificate")
    for key, file in (("ca_file", "/no/such/file.pem"), ("ca_file", str(broken)), ("cert_file", str(broken))):
        with pytest.raises(ConfigurationError) as refusal:
            backend(802, **{key: file})
        assert (refusal.value.field, refusal.value.value) == (key, file)
