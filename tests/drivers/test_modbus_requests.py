"""Requests and answers on the wire: the examples of the protocol's own specification (V1.1b3, sections 6.1 to 6.12)."""

import pytest

from autotuner.errors import DeviceRefusedError
from autotuner_drivers.modbus.lines import TcpLine
from autotuner_drivers.modbus.link import LinkSettings, ModbusLink
from autotuner_drivers.modbus.protocol import Account, Request

BITS_OF_CD_01 = (1, 0, 1, 1, 0, 0, 1, 1, 1, 0)
BITS_OF_CD_6B_05 = [int(bit) for byte in (0xCD, 0x6B, 0x05) for bit in reversed(f"{byte:08b}")]
BITS_OF_AC_DB_35 = [int(bit) for byte in (0xAC, 0xDB, 0x35) for bit in reversed(f"{byte:08b}")]


@pytest.fixture
def exchange(virtual, scripted_device):
    """Return a function that asks a device that answers as given: what it was asked, and the words that came of it."""

    def exchanged(request, answer):
        async def answering(_device, frame, writer):
            pdu = bytes.fromhex(answer)
            writer.write(frame[:4] + (len(pdu) + 1).to_bytes(2, "big") + frame[6:7] + pdu)

        async def main():
            async with scripted_device(answering).serving() as device:
                link = ModbusLink(TcpLine("device", 1502), LinkSettings(unit=17, timeout_s=0.5, retries=0))
                account = Account()
                link.users[account] = None
                link.take_line()
                await link.open()
                try:
                    words = await link.ask(request, account)
                finally:
                    await link.disconnect()
                return device.requests[0], list(words)

        return virtual(main())

    return exchanged


@pytest.mark.parametrize(
    ("request_", "asked", "answer", "words"),
    [
        (Request(1, 0x13, 0x13), "01 0013 0013", "01 03 CD6B05", BITS_OF_CD_6B_05),
        (Request(2, 0xC4, 0x16), "02 00C4 0016", "02 03 ACDB35", BITS_OF_AC_DB_35),
        (Request(3, 0x6B, 3), "03 006B 0003", "03 06 022B 0000 0064", [555, 0, 100]),
        (Request(4, 8, 1), "04 0008 0001", "04 02 000A", [10]),
    ],
)
def test_reads(exchange, request_, asked, answer, words):
    pdu = bytes.fromhex(asked)
    frame, read = exchange(request_, answer)
    assert frame[2:] == bytes.fromhex("0000") + (len(pdu) + 1).to_bytes(2, "big") + b"\x11" + pdu
    assert read == words


@pytest.mark.parametrize(
    ("request_", "asked", "answer"),
    [
        (Request(5, 0xAC, 1, (1,)), "05 00AC FF00", "05 00AC FF00"),
        (Request(5, 0xAC, 1, (0,)), "05 00AC 0000", "05 00AC 0000"),
        (Request(6, 1, 1, (3,)), "06 0001 0003", "06 0001 0003"),
        (Request(15, 0x13, 10, BITS_OF_CD_01), "0F 0013 000A 02 CD01", "0F 0013 000A"),
        (Request(16, 1, 2, (0x0A, 0x0102)), "10 0001 0002 04 000A 0102", "10 0001 0002"),
    ],
)
def test_writes(exchange, request_, asked, answer):
    pdu = bytes.fromhex(asked)
    frame, _ = exchange(request_, answer)
    assert frame[2:] == bytes.fromhex("0000") + (len(pdu) + 1).to_bytes(2, "big") + b"\x11" + pdu


def test_a_refusal(exchange):
    with pytest.raises(DeviceRefusedError, match="illegal data address"):
        exchange(Request(1, 0x04A1, 1), "81 02")
