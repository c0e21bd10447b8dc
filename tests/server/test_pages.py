"""HTTP pages by path, and the answer of a page that fails."""

import json

import pytest

from server.observability.pages import Page, PageRequest, Pages, json_page, line, ready_page


def test_pages_by_path_and_method() -> None:
    pages = Pages({"/readyz": lambda: Page(200, b"yes")}, {"/stats": json_page(lambda: {"tick": 7})})
    found = {
        path: pages.get("GET", path, trusted=False) for path in ("/", "/healthz", "/readyz?x=/stats", "/stats", "/x")
    }
    assert [page.status for page in found.values()] == [426, 200, 200, 403, 404]
    assert all(len(page.body.splitlines()) == 1 for page in found.values())
    assert ("Upgrade", "websocket") in found["/"].headers
    page = pages.get("GET", "/stats?a=b", trusted=True)
    assert (page.status, page.content_type, json.loads(page.body)) == (200, "application/json", {"tick": 7})
    assert pages.get("POST", "/stats", trusted=True).status == 405
    assert Pages().get("GET", "/stats", trusted=True).status == 404


def test_ready_or_the_reason() -> None:
    reasons = [""]
    page = ready_page(lambda: reasons[0])
    assert page().status == 200
    reasons[0] = "draining"
    assert (page().status, page().body) == (503, b"not ready: draining\n")


@pytest.mark.parametrize("figures", [lambda: {"x": object()}, lambda: 1 / 0])
def test_a_page_that_fails_is_reported_and_does_not_show_the_reason(figures: object) -> None:
    failed: list[str] = []
    pages = Pages(private={"/stats": json_page(figures)}, failed=failed.append)  # type: ignore[arg-type]
    page = pages.get("GET", "/stats", trusted=True)
    assert (page.status, page.body, failed) == (500, b"internal error\n", ["/stats"])


def test_pages_that_come_and_go_and_other_methods() -> None:
    asked: list[PageRequest] = []
    there = {"/a/live"}

    def more(request: PageRequest) -> Page | None:
        asked.append(request)
        if request.method == "DELETE" and request.authorization == "Bearer x":
            there.discard(request.path)
            return line(200, "gone")
        return line(200, "here") if request.method == "GET" and request.path in there else None

    failed: list[str] = []
    pages = Pages({"/readyz": lambda: Page(200, b"yes")}, failed=failed.append, more=more)
    assert pages.get("GET", "/a/live?x=1", trusted=True).body == b"here\n"
    assert asked == [PageRequest("GET", "/a/live", "x=1", True, "")]
    assert pages.get("GET", "/readyz", trusted=False).body == b"yes"
    assert pages.get("DELETE", "/a/live", trusted=False).status == 405
    assert pages.get("DELETE", "/a/live", trusted=False, authorization="Bearer x").status == 200
    assert pages.get("GET", "/a/live", trusted=True).status == 404
    pages = Pages(failed=failed.append, more=lambda request: 1 / 0)  # type: ignore[arg-type, return-value]
    assert pages.get("GET", "/b", trusted=True).status == 500
    assert failed == ["/b"]
