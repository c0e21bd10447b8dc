"""The log: one line per event, for people or for machines. Loggers of the standard library write to the same stream.

Only rare events are logged: nothing per tick, per message or per connection. Tokens are hidden in two ways: values with
the names of secrets, and everything in a finished line that looks like a JSON Web Token.
"""

import logging
import re
from contextvars import ContextVar
from typing import TextIO

from server.runtime.structured import structlog

SECRETS = frozenset({"token", "resume", "key", "secret", "authorization", "cookie"})
"""Names of values that are hidden."""
JWT = re.compile(r"eyJ[\w-]+\.[\w-]+\.[\w-]*")
"""Pattern of a JSON Web Token."""
HIDDEN = "[hidden]"
"""Text in place of a hidden value."""
WORLD: ContextVar[str] = ContextVar("world", default="")
"""Name of the world, one of many, whose tick runs; lines of the log have it. Empty: none."""


def set_up(level: str, form: str, stream: TextIO) -> None:
    """Sets up logging to a stream.

    Args:
        level: lowest level to log.
        form: format of a line, one of `server.config.settings.LOG_FORMATS`.
        stream: the stream.
    """
    first: list[structlog.typing.Processor] = [
        structlog.stdlib.add_log_level,
        structlog.stdlib.add_logger_name,
        _with_world,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
        structlog.processors.StackInfoRenderer(),
        structlog.processors.format_exc_info,  # a richer format would show local variables, which may be secrets
        _without_secrets,
    ]
    if form == "json":
        last: structlog.typing.Processor = structlog.processors.JSONRenderer()
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


def _with_world(
    logger: structlog.typing.WrappedLogger, method: str, event: structlog.typing.EventDict
) -> structlog.typing.EventDict:
    if name := WORLD.get():
        event.setdefault("world", name)
    return event


def _without_secrets(
    logger: structlog.typing.WrappedLogger, method: str, event: structlog.typing.EventDict
) -> structlog.typing.EventDict:
    for name in SECRETS & event.keys():
        event[name] = HIDDEN
    return event


def _without_tokens(logger: structlog.typing.WrappedLogger, method: str, line: structlog.typing.EventDict | str) -> str:
    return JWT.sub(HIDDEN, str(line))
