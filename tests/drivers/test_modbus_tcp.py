"""Requests and answers as bytes: the examples of the protocol's own specification (V1.1b3, sections 6.1 to 6.12)."""

import pytest

from autotuner_drivers.modbus_requests import Request
from autotuner_drivers.modbus_tcp import Answer, answer_of, frame_of

BITS_OF_CD_01 = (1, 0, 1, 1, 0, 0, 1, 1, 1, 0)


@pytest.mark.parametrize(
    ("request_", "pdu"),
    [
        (Request(1, 0x13, 0x13), "01 0013 0013"),
        (Request(2, 0xC4, 0x16), "02 00C4 0016"),
        (Request(3, 0x6B, 3), "03 006B 0003"),
        (Request(4, 8, 1), "04 0008 0001"),
        (Request(5, 0xAC, 1, (1,)), "05 00AC FF00"),
        (Request(5, 0xAC, 1, (0,)), "05 00AC 0000"),
        (Request(6, 1, 1, (3,)), "06 0001 0003"),
        (Request(15, 0x13, 10, BITS_OF_CD_01), "0F 0013 000A 02 CD01"),
        (Request(16, 1, 2, (0x0A, 0x0102)), "10 0001 0002 04 000A 0102"),
    ],
)
def test_requests(request_, pdu):
    pdu = bytes.fromhex(pdu)
    header = bytes.fromhex("15010000") + (len(pdu) + 1).to_bytes(2, "big") + b"\xff"
    assert frame_of(request_, 0x1501, 0xFF) == header + pdu


def test_answers():
    assert answer_of(3, bytes.fromhex("06 022B 0000 0064")) == Answer(3, registers=(555, 0, 100))
    bits = answer_of(1, bytes.fromhex("03 CD6B05")).bits
    assert (len(bits), bits[:10], bits[16:19]) == (24, [1, 0, 1, 1, 0, 0, 1, 1, 1, 1], [1, 0, 1])
    assert answer_of(6, bytes.fromhex("0001 0003")) == Answer(6, address=1)
    assert answer_of(16, bytes.fromhex("0001 0002")) == Answer(16, address=1)
    refused = answer_of(0x83, b"\x02")
    assert (refused.function_code, refused.exception_code, refused.isError()) == (3, 2, True)


@pytest.mark.parametrize(
    ("function", "data"),
    [(3, "06 022B"), (3, "03 022B00"), (4, "00 0000"), (1, "02 CD"), (6, "0001"), (16, "0001 0002 00"), (0x83, "00")],
)
def test_what_is_no_answer(function, data):
    assert answer_of(function, bytes.fromhex(data)) is None
