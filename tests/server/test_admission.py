"""Admission: which connections are accepted, by address, rate and origin, with simulated time."""

import pytest

from server.config.hosts import is_loopback, network_of
from server.config.limits import Limits
from server.net.admission import SPARE, SPARE_PER_ADDRESS, Admission, Request
from server.observability.pages import Page, Pages

JOIN = Request("GET", "/", "play.example:8765", None, upgrade=True)
HEALTH = Request("GET", "/healthz", "127.0.0.1:8765", None, upgrade=False)


def refused(page: Page | None) -> tuple[int, str]:
    assert page is not None, "the connection was accepted"
    return page.status, page.body.decode().rstrip("\n")


def test_an_address_gets_its_share_and_pages_beyond_it_and_then_nothing() -> None:
    admission = Admission(Limits(connections_per_address=2))
    for _ in range(2):
        assert admission.arrive("1.2.3.4")
        assert admission.answer(JOIN, "1.2.3.4", 0.0) is None
    for _ in range(SPARE_PER_ADDRESS):
        assert admission.arrive("1.2.3.4")
        status, text = refused(admission.answer(JOIN, "1.2.3.4", 0.0))
        assert (status, text) == (429, "too many connections from your address (2 are allowed)")
        assert refused(admission.answer(HEALTH, "1.2.3.4", 0.0)) == (200, "ok")
    assert not admission.arrive("1.2.3.4")
    assert admission.arrive("1.2.3.5"), "another address is not concerned"
    assert admission.refused == {"address": SPARE_PER_ADDRESS + 1}
    for _ in range(1 + SPARE_PER_ADDRESS):
        admission.leave("1.2.3.4")
    assert admission.arrive("1.2.3.4")
    assert admission.answer(JOIN, "1.2.3.4", 0.0) is None


def test_an_ended_connection_leaves_nothing_behind() -> None:
    admission = Admission(Limits(connections_per_address=1))
    for n in range(1000):
        address = f"10.0.{n >> 8}.{n & 255}"
        assert admission.arrive(address)
        admission.leave(address)
    assert (admission.total, len(admission._by_network)) == (0, 0)


def test_all_connections_together_have_a_limit() -> None:
    admission = Admission(Limits(connections_max=3))
    assert all(admission.arrive("127.0.0.1") for _ in range(3 + SPARE))
    status, text = refused(admission.answer(JOIN, "127.0.0.1", 0.0))
    assert (status, text) == (503, "the server is full (3 connections)")
    assert refused(admission.answer(HEALTH, "127.0.0.1", 0.0))[0] == 200, "a full server still serves pages"
    assert not admission.arrive("127.0.0.1")
    assert not admission.arrive("1.2.3.4")


def test_joins_have_a_rate_and_a_burst_of_two_seconds() -> None:
    admission = Admission(Limits(joins_per_s=10.0))

    def joins(now: float) -> int:
        n = 0
        while admission.answer(JOIN, "1.2.3.4", now) is None:
            n += 1
        return n

    assert (joins(100.0), joins(100.0), joins(100.5), joins(103.0), joins(1000.0)) == (20, 0, 5, 20, 20)
    assert refused(admission.answer(JOIN, "1.2.3.4", 1000.0))[0] == 503
    assert admission.answer(JOIN, "127.0.0.1", 1000.0) is None
    assert refused(admission.answer(HEALTH, "1.2.3.4", 1000.0))[0] == 200


def test_a_rate_below_one_in_two_seconds_still_allows_joins() -> None:
    admission = Admission(Limits(joins_per_s=0.1))
    found = [admission.answer(JOIN, "1.2.3.4", now) is None for now in (0.0, 1.0, 9.0, 10.5, 11.0, 21.0)]
    assert found == [True, False, False, True, False, True]


def test_this_machine_is_limited_only_on_request() -> None:
    exempt = Admission(Limits(connections_per_address=1))
    limited = Admission(Limits(connections_per_address=1, loopback_exempt=False))
    for address in ("127.0.0.1", "::1", "::ffff:127.0.0.1"):
        for admission in (exempt, limited):
            admission.arrive(address)
            admission.arrive(address)
        assert exempt.answer(JOIN, address, 0.0) is None
        assert refused(limited.answer(JOIN, address, 0.0))[0] == 429


def test_ipv6_counts_by_the_network_that_one_customer_has() -> None:
    assert network_of("2001:db8:1:2::1") == network_of("2001:db8:1:2:ffff::9%eth0") != network_of("2001:db8:1:3::1")
    assert network_of("::ffff:1.2.3.4") == network_of("1.2.3.4") != network_of("1.2.3.5")
    assert not is_loopback("")


@pytest.mark.parametrize(
    ("allowed", "origin", "host", "welcome"),
    [
        ((), None, "", True),
        ((), "http://localhost:8765", "localhost:8765", True),
        ((), "http://LOCALHOST", "localhost", True),
        ((), "http://192.168.1.7:8765", "192.168.1.7:8765", True),
        ((), "http://[::1]:8765", "[::1]:8765", True),
        ((), "http://192.168.1.7:81", "192.168.1.7:8765", False),
        ((), "http://evil.example:8765", "evil.example:8765", False),  # its name points to this machine
        ((), "http://127.0.0.1.evil.example", "127.0.0.1.evil.example", False),
        ((), "https://evil.example", "play.example", False),
        ((), "https://play.example.evil", "play.example", False),
        ((), "http://play.example:81", "play.example", False),
        ((), "null", "play.example", False),
        ((), "", "", False),
        ((), "https://play.example https://play.example", "play.example", False),
        (("https://a.b",), "https://A.b", "play.example", True),
        (("https://a.b/",), "https://a.b", "play.example", True),
        (("https://a.b",), "http://a.b", "play.example", False),
        (("https://a.b",), "https://x.a.b", "play.example", False),
        (("*",), "null", "play.example", True),
    ],
)
def test_browsers_come_from_known_pages(allowed: tuple[str, ...], origin: str | None, host: str, welcome: bool) -> None:
    admission = Admission(origins=allowed)
    page = admission.answer(Request("GET", "/", host, origin, upgrade=True), "1.2.3.4", 0.0)
    assert (page is None) is welcome
    if page is not None:
        assert page.status == 403


def test_a_draining_server_says_when_to_reconnect() -> None:
    wait: list[float] = []
    admission = Admission(closing=lambda: wait[0] if wait else None)
    assert admission.answer(JOIN, "127.0.0.1", 0.0) is None
    wait.append(3.2)
    page = admission.answer(JOIN, "127.0.0.1", 0.0)
    assert refused(page) == (503, "the server is going down")
    assert page is not None
    assert page.headers == (("Retry-After", "3"),)
    assert refused(admission.answer(HEALTH, "127.0.0.1", 0.0))[0] == 200


@pytest.mark.parametrize(
    ("figures", "seen_from"),
    [
        ("none", []),
        ("loopback", ["127.0.0.1", "::1", "::ffff:127.0.0.1"]),
        ("private", ["127.0.0.1", "::1", "::ffff:127.0.0.1", "10.1.2.3", "192.168.1.1", "fd00::1"]),
        (
            "all",
            ["127.0.0.1", "::1", "::ffff:127.0.0.1", "10.1.2.3", "192.168.1.1", "fd00::1", "8.8.8.8", "2a00::1", ""],
        ),
    ],
)
def test_figures_are_not_for_everyone(figures: str, seen_from: list[str]) -> None:
    admission = Admission(pages=Pages(private={"/stats": lambda: Page(200, b"{}")}), figures=figures)
    for address in (
        "127.0.0.1",
        "::1",
        "::ffff:127.0.0.1",
        "10.1.2.3",
        "192.168.1.1",
        "fd00::1",
        "8.8.8.8",
        "2a00::1",
        "",
    ):
        page = admission.answer(Request("GET", "/stats", "127.0.0.1", None, upgrade=False), address, 0.0)
        assert page is not None
        assert page.status == (200 if address in seen_from else 403), address


OWN_HOSTS = [
    "", "127.0.0.1", "127.0.0.1:8765", "[::1]", "[::1]:8765", "192.168.1.7:81", "8.8.8.8", "[2a00::1]:8765",
    "localhost", "LocalHost:8765", "localhost.", "play.example", "PLAY.example:8765", "play.example.:8765",
]  # fmt: skip
OTHER_HOSTS = [
    "evil.example", "evil.example:8765", "127.0.0.1.evil.example", "localhost.evil.example", "x.localhost", "127.1",
    "evil.example.play.example", "play.example.evil", "play.example:8765:1", "play.example 127.0.0.1",
    "[::1]evil.example", "[evil.example]", "[::1", "::1",
    "127.0.0.1%.evil.example", "[]", ":8765", ".", "*", "127.0.0.1 127.0.0.1", "\xff",
]  # fmt: skip


@pytest.mark.parametrize("path", ["/", "/live", "/live/0", "/stats", "/metrics", "/healthz", "/readyz", "/nothing"])
def test_pages_are_refused_by_a_host_name_that_is_not_the_servers_own(path: str) -> None:
    figures = {path: lambda: Page(200, b"figures")}
    admission = Admission(pages=Pages(private=figures), hosts=("127.0.0.1", "Play.example"))
    for host in OWN_HOSTS:
        assert refused(admission.answer(Request("GET", path, host, None, upgrade=False), "127.0.0.1", 0.0))[0] == 200, (
            host
        )
    assert admission.refused == {}
    for host in OTHER_HOSTS:
        status, text = refused(admission.answer(Request("GET", path, host, None, upgrade=False), "127.0.0.1", 0.0))
        assert (status, text) == (
            421, f"{host!r} is not a name of this server; its operator can add it to allowed_hosts",
        ), host  # fmt: skip
    assert admission.refused == {"host": len(OTHER_HOSTS)}


def test_an_operator_can_allow_every_host_name_for_pages_but_not_for_players() -> None:
    admission = Admission(hosts=("*",))
    for host in OTHER_HOSTS:
        assert (
            refused(admission.answer(Request("GET", "/healthz", host, None, upgrade=False), "127.0.0.1", 0.0))[0] == 200
        )
        if host != "*":
            player = Request("GET", "/", host, f"http://{host}", upgrade=True)
            assert refused(admission.answer(player, "127.0.0.1", 0.0))[0] == 403, host


def test_a_client_that_is_no_browser_may_call_the_server_as_it_likes() -> None:
    admission = Admission()
    assert admission.answer(Request("GET", "/", "evil.example:8765", None, upgrade=True), "127.0.0.1", 0.0) is None


def test_browsers_come_from_the_own_pages_by_every_own_name() -> None:
    admission = Admission(hosts=("play.example",))
    for host, origin, welcome in (
        ("play.example:8765", "http://play.example:8765", True),
        ("PLAY.example", "https://play.EXAMPLE", True),
        ("play.example:8765", "http://play.example:81", False),
        ("play.example", "http://evil.example", False),
        ("evil.example", "http://evil.example", False),
    ):
        assert (admission.answer(Request("GET", "/", host, origin, upgrade=True), "1.2.3.4", 0.0) is None) is welcome


def test_a_long_name_is_cut_in_the_answer() -> None:
    _, text = refused(Admission().answer(Request("GET", "/", "x" * 9000, None, upgrade=False), "1.2.3.4", 0.0))
    assert len(text) < 250
