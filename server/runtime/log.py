"""Logs of one line each, for people or for machines; the standard library's loggers end up in the same stream.

What is logged happens once, or rarely: nothing per tick, nothing per message, nothing per connection. Tokens are left
out twice: values under the names of secrets, and whatever in a finished line looks like a JSON Web Token.
"""

import logging
import re
from typing import TextIO

import structlog
from structlog.typing import EventDict, Processor, WrappedLogger

SECRETS = frozenset({"token", "resume", "key", "secret", "authorization", "cookie"})
JWT = re.compile(r"eyJ[\w-]+\.[\w-]+\.[\w-]*")
HIDDEN = "[hidden]"


def set_up(level: str, form: str, stream: TextIO) -> None:
    """Sends everything from `level` on to a stream, in one of `server.config.settings.LOG_FORMATS`."""
    first: list[Processor] = [
        structlog.stdlib.add_log_level,
        structlog.stdlib.add_logger_name,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
        structlog.processors.StackInfoRenderer(),
        structlog.processors.format_exc_info,  # plain: a richer one would show local variables, and so secrets
        _without_secrets,
    ]
    if form == "json":
        last: Processor = structlog.processors.JSONRenderer()
    else:
        last = structlog.dev.ConsoleRenderer(colors=stream.isatty())
    structlog.configure(
        processors=[
            structlog.stdlib.PositionalArgumentsFormatter(),
            *first,
            structlog.stdlib.ProcessorFormatter.wrap_for_formatter,
        ],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.stdlib.BoundLogger,
    )
    handler = logging.StreamHandler(stream)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=first,
            processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, last, _without_tokens],
        )
    )
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
    logging.captureWarnings(capture=True)


def _without_secrets(logger: WrappedLogger, method: str, event: EventDict) -> EventDict:
    for name in SECRETS & event.keys():
        event[name] = HIDDEN
    return event


def _without_tokens(logger: WrappedLogger, method: str, line: EventDict | str) -> str:
    return JWT.sub(HIDDEN, str(line))
