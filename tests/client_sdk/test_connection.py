"""A core behind a WebSocket, against websockets' own server side, without a socket."""

import pytest
from websockets.frames import Close, CloseCode, Frame, Opcode

from client_sdk.core import Core
from client_sdk.events import Left
from client_sdk.transports.common import CLOSE_S, LOOK_S, SILENCE_S, ConnectError
from client_sdk.transports.connection import Connection
from shared import fields, messages
from shared.messages import Bye, Hello, decode_from_client, encode
from tests.client_sdk.servers import Peer

NOW = 100.0


class Pair:
    """A connection and its peer, joined by hand."""

    def __init__(self) -> None:
        self.core = Core("Ann")
        self.connection = Connection("ws://example.org:8765", self.core)
        self.peer = Peer()
        self.frames: list[Frame] = []

    def to_peer(self) -> None:
        events = self.peer.receive(self.connection.data_to_send(NOW))
        self.frames += [event for event in events if isinstance(event, Frame)]

    def to_client(self) -> None:
        if data := self.peer.send():
            self.connection.receive(data, NOW)

    def open(self) -> "Pair":
        self.to_peer()
        self.to_client()
        self.to_peer()
        return self

    def left(self) -> Left:
        (event,) = self.core.events()
        assert isinstance(event, Left)
        return event


def test_it_says_hello_once_the_handshake_is_done() -> None:
    pair = Pair()
    assert not pair.connection.opened
    pair.open()
    assert pair.connection.opened
    assert decode_from_client(bytes(pair.frames[0].data)) == Hello(messages.VERSION, {}, "Ann")


def test_it_offers_no_compression() -> None:
    assert b"extensions" not in Pair().connection.data_to_send(NOW).lower()


def test_a_message_in_fragments_arrives_whole() -> None:
    pair = Pair().open()
    message = encode(Bye(messages.FULL, "full", -1.0))
    pair.peer.protocol.send_binary(message[:3], fin=False)
    pair.peer.protocol.send_continuation(message[3:5], fin=False)
    pair.peer.protocol.send_continuation(message[5:], fin=True)
    pair.to_client()
    assert pair.left() == Left(messages.FULL, "full", -1.0)
    assert pair.core.stats.bytes_down == len(message)


def test_bytes_may_come_one_by_one() -> None:
    pair = Pair()
    pair.to_peer()
    pair.peer.protocol.send_binary(encode(Bye(messages.FULL, "full", -1.0)))
    for byte in pair.peer.send():
        pair.connection.receive(bytes((byte,)), NOW)
    assert pair.left().code == messages.FULL


def test_text_is_refused() -> None:
    pair = Pair().open()
    pair.peer.protocol.send_text(b"hello")
    pair.to_client()
    pair.to_peer()
    assert pair.left().code == messages.TEXT
    assert pair.frames[-1].opcode is Opcode.CLOSE
    assert Close.parse(pair.frames[-1].data).code == messages.TEXT


def test_a_malformed_message_closes_with_a_code_and_a_reason() -> None:
    pair = Pair().open()
    pair.peer.protocol.send_binary(b"\xc1 no such thing")
    pair.to_client()
    assert pair.left().code == messages.MALFORMED
    pair.to_peer()
    close = Close.parse(pair.frames[-1].data)
    assert close.code == messages.MALFORMED
    assert "malformed" in close.reason


def test_a_long_reason_is_cut_to_what_a_close_frame_holds() -> None:
    pair = Pair().open()
    pair.core.close_request = (messages.MALFORMED, "ä" * 100)
    pair.to_peer()
    assert Close.parse(pair.frames[-1].data).reason == "ä" * 61


def test_an_oversized_message_closes() -> None:
    pair = Pair().open()
    pair.peer.protocol.send_binary(bytes(fields.MESSAGE_MAX + 1))
    pair.to_client()
    assert pair.left().code == messages.TOO_BIG


def test_the_servers_close_code_and_reason_arrive() -> None:
    pair = Pair().open()
    pair.peer.protocol.send_close(messages.TOO_SLOW, "nothing read for 5 s")
    pair.to_client()
    assert pair.left() == Left(messages.TOO_SLOW, "nothing read for 5 s")
    assert not pair.connection.done(NOW)
    pair.connection.receive_eof(NOW)
    assert pair.connection.done(NOW)


def test_a_bye_before_the_close_frame_has_the_last_word() -> None:
    pair = Pair().open()
    pair.peer.protocol.send_binary(encode(Bye(messages.GOING_AWAY, "the server is going down", 2.0)))
    pair.peer.protocol.send_close(messages.GOING_AWAY, "")
    pair.to_client()
    assert pair.left() == Left(messages.GOING_AWAY, "the server is going down", 2.0)


def test_a_stream_that_breaks_off_is_a_loss() -> None:
    pair = Pair().open()
    pair.connection.receive_eof(NOW)
    assert pair.left().code == CloseCode.ABNORMAL_CLOSURE
    assert pair.connection.done(NOW)
    assert pair.connection.data_to_send(NOW) == b""


def test_a_bye_is_sent_and_then_the_connection_closes() -> None:
    pair = Pair().open()
    pair.core.close()
    pair.to_peer()
    bye, close = pair.frames[-2:]
    assert isinstance(decode_from_client(bytes(bye.data)), Bye)
    assert Close.parse(close.data).code == 1000
    pair.to_client()
    pair.connection.receive_eof(NOW)
    assert pair.connection.done(NOW)


def test_a_server_that_never_closes_is_not_waited_for() -> None:
    pair = Pair().open()
    pair.core.close()
    pair.to_peer()
    assert not pair.connection.done(NOW + CLOSE_S)
    assert pair.connection.done(NOW + CLOSE_S + 0.1)


def test_a_server_that_is_silent_for_long_is_left() -> None:
    pair = Pair().open()
    for k in range(round(SILENCE_S / LOOK_S)):
        pair.connection.look(NOW + k * LOOK_S)
    pair.peer.protocol.send_binary(encode(messages.Pong(1.0, 2.0)))  # at the last moment
    pair.to_client()
    later = NOW + 100
    for k in range(round(SILENCE_S / LOOK_S)):
        pair.connection.look(later + k * LOOK_S)
    assert not pair.core.events()
    pair.connection.look(later + SILENCE_S + LOOK_S)
    assert pair.left() == Left(CloseCode.ABNORMAL_CLOSURE, "nothing received for 10 s")
    assert pair.connection.done(later)


def test_a_goodbye_without_an_end_is_not_waited_for() -> None:
    pair = Pair().open()
    pair.peer.protocol.send_binary(encode(Bye(messages.FULL, "full", -1.0)))
    pair.to_client()
    for k in range(12):
        pair.connection.look(NOW + k)
    assert pair.left().reason == "full"
    assert pair.connection.done(NOW + 12)


def test_silence_while_the_program_slept_does_not_count() -> None:
    pair = Pair().open()
    for k in range(8):
        pair.connection.look(NOW + 60 * k)
    assert not pair.core.events()


def test_what_comes_after_the_end_is_ignored() -> None:
    pair = Pair().open()
    pair.connection.broke("the cable", NOW)
    pair.connection.receive(b"more", NOW)
    pair.connection.broke("the cable again", NOW)
    assert pair.left().reason == "the cable"


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n", "HTTP status 404"),
        (b"SSH-2.0-OpenSSH_9.6\r\n", "did not receive a valid HTTP response"),
    ],
)
def test_something_else_there_is_named(answer: bytes, says: str) -> None:
    pair = Pair()
    pair.connection.data_to_send(NOW)
    pair.connection.receive(answer, NOW)
    pair.connection.receive_eof(NOW)
    assert isinstance(pair.connection.refused, ConnectError)
    assert "ws://example.org:8765: something is there, but" in str(pair.connection.refused)
    assert says in str(pair.connection.refused)
    assert pair.core.state == "closed"


@pytest.mark.parametrize(
    "url", ["http://localhost:8765", "localhost:8765", "ws://", "ws://localhost:99999", "ws://h:p"]
)
def test_a_wrong_address_is_explained(url: str) -> None:
    with pytest.raises(ConnectError, match="looks like ws://localhost:8765"):
        Connection(url, Core())


def test_another_server_of_the_world_keeps_path_and_tls() -> None:
    core = Core()
    assert Connection("wss://play.example/arena?a=1", core).url == "wss://play.example/arena?a=1"
    core.travel.server = "ws://10.0.0.2:8766"
    connection = Connection("wss://play.example/arena?a=1", core)
    assert connection.url == "wss://10.0.0.2:8766/arena?a=1"
    assert (connection.uri.secure, connection.uri.host, connection.uri.port) == (True, "10.0.0.2", 8766)
    core.travel.server = "wss://edge.example"
    assert Connection("ws://play.example", core).url == "wss://edge.example/arena?a=1"
