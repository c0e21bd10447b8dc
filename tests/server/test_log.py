"""Log lines for people and for machines, and secrets that no line has."""

import io
import json
import logging
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import structlog

from server.auth.tokens import issue
from server.config.settings import LOG_FORMATS
from server.runtime import log

ROOT = Path(__file__).parents[2]
TOKEN = issue(b"k" * 32, "ann", 3600, 1.8e9)


@pytest.fixture(autouse=True)
def _as_before() -> Iterator[None]:
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)
    logging.captureWarnings(capture=False)
    structlog.reset_defaults()


def lines(form: str, level: str = "info") -> io.StringIO:
    stream = io.StringIO()
    log.set_up(level, form, stream)
    return stream


def test_both_kinds_of_loggers_give_one_line_of_json_each() -> None:
    stream = lines("json")
    structlog.stdlib.get_logger("server").info("started", scene="flat", tick_rate=32)
    logging.getLogger("server.net.websocket").warning("internal error in %s", "open")
    logging.getLogger("server").debug("not this")
    first, second = map(json.loads, stream.getvalue().splitlines())
    assert first.pop("timestamp").endswith("Z")
    assert first == {"event": "started", "scene": "flat", "tick_rate": 32, "level": "info", "logger": "server"}
    assert (second["event"], second["level"]) == ("internal error in open", "warning")


def test_a_stack_is_one_field_of_one_line() -> None:
    stream = lines("json")
    try:
        _ = 1 // 0
    except ZeroDivisionError:
        logging.getLogger("a").exception("broken")
        structlog.stdlib.get_logger("b").exception("broken")
    found = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert ["ZeroDivisionError" in entry["exception"] for entry in found] == [True, True]


def test_people_read_the_same() -> None:
    stream = lines("pretty")
    structlog.stdlib.get_logger("server").info("started", scene="flat")
    logging.getLogger("x").error("cannot %s", "read")
    first, second = stream.getvalue().splitlines()
    assert "started" in first
    assert "scene=flat" in first
    assert "\033" not in first, "no colours without a terminal"
    assert "error" in second
    assert "cannot read" in second


@pytest.mark.parametrize("form", LOG_FORMATS)
def test_no_token_is_in_any_line(form: str) -> None:
    stream = lines(form)
    logger = structlog.stdlib.get_logger("server")
    hidden_in_a_local_variable = TOKEN
    logger.info("joined", token=TOKEN, resume=b"opaque", name="ann")
    logger.info("joined", hello={"token": TOKEN})
    logger.info(f"asked for /?token={TOKEN}")
    logging.getLogger("x").warning("request %r", f"GET /?t={TOKEN} HTTP/1.1")
    try:
        raise ValueError(f"token {hidden_in_a_local_variable}")
    except ValueError:
        logger.exception("broken")
        logging.getLogger("x").exception("broken")
    text = stream.getvalue()
    assert not any(part in text for part in TOKEN.split("."))
    assert "opaque" not in text
    assert text.count(log.HIDDEN) >= 7
    assert "name" in text


def test_the_log_does_without_rich() -> None:
    program = "import sys, server.app, server.runtime.log; print('rich' in sys.modules); import rich.console"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("False\n", "")
