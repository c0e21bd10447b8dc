"""What to do about being refused: a server says why, this says what a program can do about it."""

from shared import messages

ADVICE = {
    messages.WRONG_VERSION: "use the client_sdk that comes with the server",
    messages.WRONG_SCENE: "connect with the scene that the server plays, or without scene= to take its own",
    messages.UNAUTHORISED: "connect with token=..., a valid one; whoever runs the server issues them",
    messages.TAKEN_OVER: "is the program running twice?",
}
TLS_ALERT = b"\x15\x03"
"""How a server that speaks TLS answers to who does not."""


def advised(code: int, reason: str) -> str:
    """A server's reason, with advice if there is any."""
    return f"{reason}; {ADVICE[code]}" if reason and code in ADVICE else reason


def untrusted(url: str, reason: str, why: str) -> str:
    """Why there is no TLS: `reason` is OpenSSL's name for it, `why` what it says of a certificate."""
    if reason == "CERTIFICATE_VERIFY_FAILED":
        return (
            f"{url}: no secure connection, the server's certificate is not trusted ({why}); if it is one of your own: "
            'connect(url, tls=ssl.create_default_context(cafile="cert.pem"))'
        )
    if reason in ("WRONG_VERSION_NUMBER", "RECORD_LAYER_FAILURE", "PACKET_LENGTH_TOO_LONG"):
        return f"{url}: no secure connection, the server does not speak TLS; try {url.replace('wss:', 'ws:')}"
    return f"{url}: no secure connection ({reason})"
