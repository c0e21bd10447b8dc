"""Servers for tests of clients: the real one as a process, and scripted ones that misbehave."""

import contextlib
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from websockets.frames import Frame
from websockets.http11 import Request
from websockets.protocol import Event
from websockets.server import ServerProtocol

from tests.patience import PATIENCE_S

ROOT = Path(__file__).resolve().parents[2]


@contextlib.contextmanager
def real_server(
    *flags: str, program: Sequence[str] = (sys.executable, "-m", "server"), folder: Path = ROOT
) -> Iterator[str]:
    """Yields the URL of a server process. It must end with exit code 0."""
    command = [*program, "--host", "127.0.0.1", "--port", "0", "--log-level", "warning", *flags]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line.startswith("listening on "), "the server did not start"
            yield line.split()[-1]
            process.terminate()
            assert process.wait(PATIENCE_S) == 0
        finally:
            if process.poll() is None:
                process.kill()


class Peer:
    """The server's side of a WebSocket without a socket, for tests of `Connection`."""

    def __init__(self) -> None:
        self.protocol = ServerProtocol(max_size=None)
        self.path = ""
        """Path of the client's request."""

    def receive(self, data: bytes) -> list[Event]:
        """Takes bytes of the client and returns the events in them. A request for a WebSocket is accepted."""
        if data:
            self.protocol.receive_data(data)
        events = self.protocol.events_received()
        for event in events:
            if isinstance(event, Request):
                self.path = event.path
                self.protocol.send_response(self.protocol.accept(event))
        return events

    def send(self) -> bytes:
        return b"".join(self.protocol.data_to_send())


@contextlib.contextmanager
def scripted_server(*scripts: Callable[[socket.socket], object]) -> Iterator[str]:
    """Yields the URL of a server that runs a script with each of its connections in turn, and then closes it."""
    failed: list[BaseException] = []

    def serve() -> None:
        try:
            for script in scripts:
                sock, _ = listener.accept()
                with sock:
                    sock.settimeout(PATIENCE_S)
                    script(sock)
        except BaseException as error:
            failed.append(error)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(PATIENCE_S)
        thread = threading.Thread(target=serve)
        thread.start()
        yield f"ws://127.0.0.1:{listener.getsockname()[1]}"
        thread.join(PATIENCE_S)
    assert not failed, failed


def request(sock: socket.socket) -> bytes:
    """Returns a client's request, up to the end of its head."""
    data = b""
    while b"\r\n\r\n" not in data:
        received = sock.recv(65536)
        assert received, "the client has closed"
        data += received
    return data


def accept(sock: socket.socket) -> Peer:
    """Runs the server's side of the handshake. Returns the peer."""
    peer = Peer()
    while not any(isinstance(event, Request) for event in peer.receive(sock.recv(65536))):
        pass
    sock.sendall(peer.send())
    return peer


@contextlib.contextmanager
def silent_server() -> Iterator[str]:
    """Yields the URL of a server that accepts its first client and then sends nothing."""
    over = threading.Event()

    def script(sock: socket.socket) -> None:
        accept(sock)
        over.wait(PATIENCE_S)

    with scripted_server(script) as url:
        try:
            yield url
        finally:
            over.set()


def until_closed(sock: socket.socket, peer: Peer) -> list[Frame]:
    """Returns all frames that the client still sends, and carries out the closing handshake."""
    frames: list[Frame] = []
    while data := sock.recv(65536):
        frames += [event for event in peer.receive(data) if isinstance(event, Frame)]
        sock.sendall(peer.send())
        if peer.protocol.eof_sent:
            break
    return frames
