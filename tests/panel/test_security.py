"""Who may ask the panel, from where, and how much. Each check was taken out once: a test fails."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from starlette.testclient import TestClient, WebSocketDenialResponse

from canwall.panel.launch import Launcher
from canwall.panel.security import MOST_BYTES, Access
from canwall.panel.server import make_app
from canwall.panel.session import Session

HOST = "127.0.0.1:8123"
OWN = f"http://{HOST}"
PATHS = ["/", "/static/main.js", "/uplot/uPlot.js", "/api/configs", "/api/recorded", "/nothing"]


@pytest.fixture
def access() -> Access:
    return Access(["127.0.0.1", "localhost", "[::1]"], 8123, tls=False)


@pytest.fixture
def client(access: Access, tmp_path: Path) -> Iterator[TestClient]:
    session = Session(tmp_path, Launcher(tmp_path))
    yield TestClient(make_app(session, access), base_url=OWN, follow_redirects=False)
    session.end()


@pytest.fixture
def page(client: TestClient, access: Access) -> TestClient:
    """The client with the cookie that a page has."""
    client.get("/", params={"token": access.token})
    return client


def bearer(access: Access) -> dict[str, str]:
    return {"Authorization": f"Bearer {access.token}"}


def socket_status(client: TestClient, headers: dict[str, str]) -> int:
    try:
        with client.websocket_connect(f"ws://{HOST}/live", headers=headers):
            return 101
    except WebSocketDenialResponse as denial:
        return int(denial.status_code)


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Authorization": "Bearer "},
        {"Authorization": "Bearer wrong"},
        {"Authorization": "Basic wrong"},
        {"Cookie": "canwall-8123=wrong"},
        {"Cookie": "canwall-8123="},
    ],
)
def test_nothing_without_the_token(client: TestClient, path: str, headers: dict[str, str]) -> None:
    assert client.get(path, headers=headers).status_code == 403
    assert client.post(path, headers=headers | {"Origin": OWN}).status_code == 403
    assert socket_status(client, headers | {"Origin": OWN}) == 403


def test_token_of_another_panel(client: TestClient, access: Access) -> None:
    other = Access(["127.0.0.1"], 8123, tls=False)
    assert client.get("/", params={"token": other.token}).status_code == 403
    assert client.get("/", headers=bearer(other)).status_code == 403
    cookie = {"Cookie": f"canwall-9999={access.token}"}
    assert client.get("/", headers=cookie).status_code == 403
    assert client.get("/static/main.js", params={"token": access.token}).status_code == 403


def test_entrance(client: TestClient, access: Access) -> None:
    answer = client.get("/", params={"token": access.token})
    assert answer.status_code == 303
    assert answer.headers["location"] == "/"
    name, *attributes = answer.headers["set-cookie"].split("; ")
    assert name == f"canwall-8123={access.token}"
    assert {word.lower() for word in attributes} == {"httponly", "path=/", "samesite=strict"}
    assert client.get("/").status_code == 200
    # Cookies of other servers of this host are sent as well, whatever they look like.
    cookies = f'a="b; ;=;{{}}; canwall-8123={access.token}; c'
    assert client.get("/", headers={"Cookie": cookies}).status_code == 200


def test_cookie_of_tls_is_never_sent_without(tmp_path: Path) -> None:
    access = Access(["bench.local"], 443, tls=True)
    session = Session(tmp_path, Launcher(tmp_path))
    client = TestClient(
        make_app(session, access), base_url="https://bench.local", follow_redirects=False
    )
    answer = client.get("/", params={"token": access.token})
    assert "secure" in answer.headers["set-cookie"].lower().split("; ")


def test_ticket_lets_in_once(client: TestClient, access: Access) -> None:
    ticket = access.ticket()
    assert ticket != access.token
    assert client.get("/", params={"token": ticket}).status_code == 303
    assert client.get("/", params={"token": ticket}).status_code == 403


@pytest.mark.parametrize(
    "host",
    [
        "evil.example:8123",  # rebound to 127.0.0.1
        "127.0.0.1.evil.example:8123",
        "127.0.0.1:8124",
        "127.0.0.1",
        "",
    ],
)
def test_host_is_the_server(client: TestClient, access: Access, host: str) -> None:
    headers = bearer(access) | {"Host": host}
    assert client.get("/", headers=headers).status_code == 421
    assert client.get("/", headers=headers, params={"token": access.token}).status_code == 421
    assert client.post("/api/start", headers=headers, json={}).status_code == 421
    assert socket_status(client, headers | {"Origin": f"http://{host}"}) == 421


@pytest.mark.parametrize("host", [HOST, "localhost:8123", "LOCALHOST:8123", "[::1]:8123"])
def test_own_hosts(client: TestClient, access: Access, host: str) -> None:
    assert client.get("/", headers=bearer(access) | {"Host": host}).status_code == 200


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "http://evil.example:8123",
        "https://127.0.0.1:8123",
        "http://127.0.0.1:8124",
        "http://localhost:8123",  # ours, but not the page that this cookie belongs to
        "null",
        "",
        None,
    ],
)
def test_origin_is_the_page(page: TestClient, access: Access, origin: str | None) -> None:
    headers = {} if origin is None else {"Origin": origin}
    assert page.post("/api/start", headers=headers, json={}).status_code == 403
    assert socket_status(page, headers) == 403
    if origin is not None:
        assert socket_status(page, headers | bearer(access)) == 403


def test_own_origin_and_programs(page: TestClient, access: Access) -> None:
    wrong = {"config": "no such"}
    assert page.post("/api/start", headers={"Origin": OWN}, json=wrong).status_code == 400
    assert socket_status(page, {"Origin": OWN}) == 101
    page.cookies.clear()
    assert page.post("/api/start", headers=bearer(access), json=wrong).status_code == 400
    assert socket_status(page, bearer(access)) == 101


def test_no_get_changes_anything(page: TestClient) -> None:
    assert page.get("/api/start").status_code == 405
    assert page.head("/api/start").status_code == 405


@pytest.mark.parametrize("path", [*PATHS, "/static/../server.py", "/static/%2e%2e/server.py"])
@pytest.mark.parametrize("known", [True, False])
def test_headers_of_every_answer(
    client: TestClient, access: Access, path: str, known: bool
) -> None:
    answer = client.get(path, headers=bearer(access) if known else {})
    policy = dict(
        part.split(" ", 1) for part in answer.headers["content-security-policy"].split("; ")
    )
    assert policy["default-src"] == "'none'"
    assert policy["frame-ancestors"] == policy["base-uri"] == policy["form-action"] == "'none'"
    assert {policy[kind] for kind in ("script-src", "style-src", "connect-src")} == {"'self'"}
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["referrer-policy"] == "no-referrer"
    assert answer.headers["cache-control"] == "no-store"
    assert "access-control-allow-origin" not in answer.headers
    assert access.token not in answer.text
    if ".." in path or "%2e" in path:
        assert answer.status_code in (403, 404)


def test_page_has_nothing_that_the_policy_forbids() -> None:
    text = (Path(make_app.__code__.co_filename).parent / "page" / "index.html").read_text()
    for word in ("<style", " style=", "http://", "https://", "javascript:", " onclick", " onload"):
        assert word not in text.replace('xmlns="http://www.w3.org/2000/svg"', "")
    assert text.count("<script") == text.count("<script src=") + text.count(
        '<script type="module" src='
    )


@pytest.mark.parametrize("chunked", [True, False])
def test_large_body(client: TestClient, access: Access, chunked: bool) -> None:
    body = b" " * (MOST_BYTES + 1)
    content = iter([body[:5000]] * 20) if chunked else body
    answer = client.post("/api/start", headers=bearer(access), content=content)
    assert answer.status_code == 413
    # One byte less is only wrong.
    answer = client.post("/api/start", headers=bearer(access), content=body[1:])
    assert answer.status_code == 400


@pytest.mark.parametrize("body", [b"", b"[]", b"{", b"[" * 60_000, b'{"config": 1}', b'{"a": NaN}'])
def test_malformed_body(client: TestClient, access: Access, body: bytes) -> None:
    answer = client.post("/api/start", headers=bearer(access), content=body)
    assert answer.status_code == 400
    assert answer.json()["ok"] is False
