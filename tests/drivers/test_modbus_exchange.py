"""The short way of Modbus TCP against the library's own: the same bytes asked, the same answers taken."""

import asyncio

import async_solipsism
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymodbus.exceptions import ConnectionException, ModbusIOException
from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU
from pymodbus.transaction import TransactionManager
from pymodbus.transport import CommParams, CommType

from autotuner_drivers.modbus_exchange import Exchange, UnreadableAnswerError
from autotuner_drivers.modbus_requests import Request

DEVICE = FramerSocket(DecodePDU(is_server=True))
TIMEOUT_S = 0.5
words = st.integers(0, 0xFFFF)
addresses = st.integers(0, 0xFFFF)


class Wire:
    """A transport that keeps what is sent."""

    def __init__(self):
        self.sent = []

    def set_protocol(self, protocol):
        self.protocol = protocol

    def write(self, packet):
        self.sent.append(packet)

    def close(self):
        pass


@st.composite
def requests(draw):
    function = draw(st.sampled_from([3, 4, 6, 16, 3, 4, 6, 16, 1, 2, 5, 15]))
    if function < 5:
        return Request(function, draw(addresses), draw(st.integers(1, 2000 if function < 3 else 125)))
    longest = {5: 1, 6: 1, 15: 40, 16: 123}[function]
    values = draw(st.lists(words if function in {6, 16} else st.integers(0, 1), min_size=1, max_size=longest))
    return Request(function, draw(addresses), len(values), tuple(values))


@st.composite
def answers(draw, asked, unit, transaction):
    """Return bytes that a device may send: an answer as it should be, or with one or two things wrong."""
    held = draw(st.randoms()).choices(range(0x10000), k=asked.count)
    answer = DecodePDU(is_server=False).lookupPduClass(bytes((0, asked.function)))(
        dev_id=unit,
        transaction_id=transaction,
        address=asked.address,
        count=asked.count,
        registers=held,
        bits=[word % 2 == 1 for word in held],
    )
    frame = DEVICE.buildFrame(answer)
    for _ in range(draw(st.integers(0, 2))):
        frame = draw(st.sampled_from(WRONGS))(draw, frame)
    return frame


def wrong_header(draw, frame):
    place = draw(st.integers(0, 7))
    return frame[:place] + draw(st.binary(min_size=1, max_size=1)) + frame[place + 1 :]


def wrong_address_or_size(draw, frame):
    """One byte after the function, which confirms the address or the number of registers, or tells the length."""
    place = draw(st.sampled_from([8, 8, 9, 10, 11]))
    return frame[:place] + draw(st.binary(min_size=1, max_size=1)) + frame[place + 1 :]


def another_transaction(draw, frame):
    return draw(st.integers(0, 65000)).to_bytes(2, "big") + frame[2:]


def longer(draw, frame):
    return frame + draw(st.sampled_from([b"\0", b"\0\7", frame]))


def shorter(draw, frame):
    return frame[: -draw(st.integers(1, 5))]


def refusal(draw, frame):
    return frame[:4] + b"\0\3" + frame[6:7] + bytes(((frame[7:8] or b"\0")[0] | 0x80, draw(st.integers(0, 12))))


def anything(draw, _):
    return draw(st.binary(max_size=20))


WRONGS = (
    wrong_header,
    wrong_address_or_size,
    wrong_address_or_size,
    another_transaction,
    longer,
    shorter,
    refusal,
    anything,
)


def manager():
    """Return the library's end of a connection."""
    params = CommParams(comm_type=CommType.TCP, timeout_connect=TIMEOUT_S)
    made = TransactionManager(params, FramerSocket(DecodePDU(is_server=False)), 0, False, None, None, None)
    made.transport = Wire()
    return made


def exchange():
    """Return ours, in its place, and the transport."""
    library = manager()
    ours, wire = Exchange(library), library.transport
    ours.begin()
    assert wire.protocol is ours
    return ours, wire, library


def run(main):
    with asyncio.Runner(loop_factory=async_solipsism.EventLoop) as runner:
        return runner.run(main)


def told(asked, answer):
    """Return what came of an answer of the library, or of ours."""
    if isinstance(answer, tuple):
        return answer
    if answer.isError():
        return "refused", answer.exception_code
    return asked.mismatch(answer) or asked.words_of(answer)


UNREADABLE = "cannot be decoded"


def outcome(asked, pieces, answer, received, library):
    """Return what comes of pieces of an answer: the answer, and what is kept of them.

    The library raises where it cannot decode one, which closes the connection; ours fails the request alone.
    """
    try:
        for piece in pieces:
            received(piece)
            if answer.done() and isinstance(answer.exception(), UnreadableAnswerError):
                return UNREADABLE, library.recv_buffer
    except ModbusIOException:
        return UNREADABLE, b""
    return told(asked, answer.result()) if answer.done() else None, library.recv_buffer


@given(asked=requests(), unit=st.integers(0, 255), before=st.integers(1, 300))
def test_what_is_asked_is_what_the_library_asks(asked, unit, before):
    async def sent():
        ours, wire, _ = exchange()
        for _ in range(before):
            ours.ask(asked, unit, 0.0)
        ours.end()
        return wire.sent

    for transaction, frame in enumerate(run(sent()), 1):
        message = asked.pdu(unit)
        message.transaction_id = transaction
        assert frame == DEVICE.buildFrame(message)


def test_transactions_are_counted_round():
    async def counted():
        ours, wire, _ = exchange()
        for _ in range(65_002):
            ours.ask(Request(3, 0, 1), 1, 0.0)
        ours.end()
        return [int.from_bytes(frame[:2], "big") for frame in wire.sent[-4:]]

    assert run(counted()) == [64_999, 65_000, 1, 2]


@settings(max_examples=600)
@given(data=st.data(), asked=requests(), unit=st.integers(0, 255), before=st.integers(0, 300))
def test_an_answer_means_what_the_library_says(data, asked, unit, before):
    """Whole or in pieces, of this request or another, a refusal, damaged, or no answer at all."""

    async def main():
        ours, _, library = exchange()
        theirs, message = manager(), asked.pdu(unit)
        for _ in range(before + 1):
            answer = ours.ask(asked, unit, 0.0)
            message.transaction_id = theirs.getNextTID()
        theirs.pdu_send(message)
        came = data.draw(answers(asked, unit, message.transaction_id))
        cuts = sorted(data.draw(st.lists(st.integers(1, 12), max_size=2)))
        pieces = [p for a, b in zip([0, *cuts], [*cuts, None], strict=True) if (p := came[a:b])]
        both = (
            outcome(asked, pieces, answer, ours.data_received, library),
            outcome(asked, pieces, theirs.response_future, theirs.data_received, theirs),
        )
        ours.end()
        return both

    ours, theirs = run(main())
    assert ours == theirs


def test_the_usual_answer_is_known_by_its_bytes():
    """So the comparison above is one of two ways, not of the library with itself."""

    async def main():
        ours, _, library = exchange()
        library.data_received = None
        answer = ours.ask(Request(3, 0x6B, 3), 17, 0.0)
        ours.data_received(bytes.fromhex("0001 0000 0009 11 03 06 022B 0000 0064"))
        ours.end()
        return answer.result()

    assert run(main()) == (555, 0, 100)


def test_every_request_has_its_whole_time_limit():
    """Though one timer looks at many: asked 0.4 s after one that was answered, it fails at 0.9 s."""

    async def main():
        loop, (ours, *_) = asyncio.get_running_loop(), exchange()
        begun_s = loop.time()
        ours.ask(Request(6, 1, 1, (3,)), 1, begun_s)
        ours.data_received(bytes.fromhex("0001 0000 0006 01 06 0001 0003"))
        await asyncio.sleep(0.4)
        with pytest.raises(ModbusIOException):
            await ours.ask(Request(3, 0, 1), 1, loop.time())
        return loop.time() - begun_s

    assert run(main()) == pytest.approx(0.9, abs=1e-3)


def test_after_a_loss_nothing_is_asked():
    async def main():
        ours, *_ = exchange()
        answer = ours.ask(Request(3, 0, 1), 1, 0.0)
        ours.connection_lost(None)
        with pytest.raises(ConnectionResetError):
            await answer
        with pytest.raises(ConnectionException):
            ours.ask(Request(3, 0, 1), 1, 0.0)

    run(main())
