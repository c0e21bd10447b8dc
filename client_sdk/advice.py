"""Advice for a client that was refused: the server says why, and these texts add what the program can do about it."""

from shared import messages

ADVICE = {
    messages.WRONG_VERSION: "use the client_sdk that comes with the server",
    messages.WRONG_SCENE: "connect with the scene that the server plays, or without scene= to take its own",
    messages.UNAUTHORISED: "connect with token=... and a valid token; the operator of the server issues them",
    messages.TAKEN_OVER: "is the program running twice?",
}
"""Advice by close code."""
TLS_ALERT = b"\x15\x03"
"""First bytes of a TLS server's answer to a client that does not use TLS."""


def advised(code: int, reason: str) -> str:
    """Returns a server's reason, followed by the advice for the close code, if there is any."""
    return f"{reason}; {ADVICE[code]}" if reason and code in ADVICE else reason


def untrusted(url: str, reason: str, why: str) -> str:
    """Returns the error text for a TLS connection that failed.

    Args:
        url: address of the server.
        reason: OpenSSL's name of the failure.
        why: OpenSSL's remark on the certificate; used if the certificate is not trusted.
    """
    if reason == "CERTIFICATE_VERIFY_FAILED":
        return (
            f"{url}: no secure connection, the server's certificate is not trusted ({why}); if it is one of your own: "
            'connect(url, tls=ssl.create_default_context(cafile="cert.pem"))'
        )
    if reason in ("WRONG_VERSION_NUMBER", "RECORD_LAYER_FAILURE", "PACKET_LENGTH_TOO_LONG"):
        return f"{url}: no secure connection, the server does not speak TLS; try {url.replace('wss:', 'ws:')}"
    return f"{url}: no secure connection ({reason})"
