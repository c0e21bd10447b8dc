"""Other ends for a client: the real server as a process, and scripted ones that misbehave on demand."""

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

ROOT = Path(__file__).resolve().parents[2]


@contextlib.contextmanager
def real_server(
    *flags: str, program: Sequence[str] = (sys.executable, "-m", "server"), folder: Path = ROOT
) -> Iterator[str]:
    """The URL of a server process, which has to end well."""
    command = [*program, "--host", "127.0.0.1", "--port", "0", "--log-level", "warning", *flags]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert line.startswith("listening on "), "the server did not start"
            yield line.split()[-1]
            process.terminate()
            assert process.wait(10) == 0
        finally:
            if process.poll() is None:
                process.kill()


class Peer:
    """A server's side of a WebSocket, without a socket: what `Connection` talks to."""

    def __init__(self) -> None:
        self.protocol = ServerProtocol(max_size=None)

    def receive(self, data: bytes) -> list[Event]:
        """What these bytes say; a request for a WebSocket is granted."""
        if data:
            self.protocol.receive_data(data)
        events = self.protocol.events_received()
        for event in events:
            if isinstance(event, Request):
                self.protocol.send_response(self.protocol.accept(event))
        return events

    def send(self) -> bytes:
        return b"".join(self.protocol.data_to_send())


@contextlib.contextmanager
def scripted_server(script: Callable[[socket.socket], object]) -> Iterator[str]:
    """The URL of a server that does `script` with its first connection, then closes it."""
    failed: list[BaseException] = []

    def serve() -> None:
        try:
            sock, _ = listener.accept()
            with sock:
                sock.settimeout(10)
                script(sock)
        except BaseException as error:
            failed.append(error)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(10)
        thread = threading.Thread(target=serve)
        thread.start()
        yield f"ws://127.0.0.1:{listener.getsockname()[1]}"
        thread.join(10)
    assert not failed, failed


def accept(sock: socket.socket) -> Peer:
    """The handshake, from a server's side."""
    peer = Peer()
    while not any(isinstance(event, Request) for event in peer.receive(sock.recv(65536))):
        pass
    sock.sendall(peer.send())
    return peer


@contextlib.contextmanager
def silent_server() -> Iterator[str]:
    """The URL of a server that accepts its first client and says nothing more, while it lasts."""
    over = threading.Event()

    def script(sock: socket.socket) -> None:
        accept(sock)
        over.wait(20)

    with scripted_server(script) as url:
        try:
            yield url
        finally:
            over.set()


def until_closed(sock: socket.socket, peer: Peer) -> list[Frame]:
    """Everything that the client still sends, with the closing handshake carried out."""
    frames: list[Frame] = []
    while data := sock.recv(65536):
        frames += [event for event in peer.receive(data) if isinstance(event, Frame)]
        sock.sendall(peer.send())
        if peer.protocol.eof_sent:
            break
    return frames
