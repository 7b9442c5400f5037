"""Who may read the status page: addresses, names, origins, tokens."""

from pathlib import Path

import pytest

from vram_arbiter.clients.observer.page.access import Access, read_token
from vram_arbiter.schemas.config.observer import load_observer
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.urls import HttpAddress, http_address

HOME = HttpAddress("127.0.0.1", 9870)
OUT = HttpAddress("192.0.2.7", 9870)
TOKEN = "0123456789abcdef0123456789abcdef"


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("9870", "127.0.0.1:9870"),
        ("localhost:0", "127.0.0.1:0"),
        ("[::1]:80", "[::1]:80"),
        ("192.0.2.7:1", "192.0.2.7:1"),
    ],
)
def test_addresses(text: str, wanted: str) -> None:
    assert str(http_address(text)) == wanted


@pytest.mark.parametrize("text", ["", "::1:80", "host:80", "127.0.0.1:", "127.0.0.1:65536", "x"])
def test_what_is_not_an_address(text: str) -> None:
    with pytest.raises(ValueError, match=r"expected ADDRESS:PORT such as 127\.0\.0\.1:9870, got"):
        http_address(text)


def test_beyond_loopback_the_configuration_needs_a_token_file() -> None:
    with pytest.raises(ConfigError, match=r"(?s)0\.0\.0\.0:80 is not a loopback.*http\.token_file"):
        load_observer("http:\n  listen: 0.0.0.0:80\n", "a.yaml")
    for host in ("127.0.0.1", "127.8.8.8", "[::1]"):
        assert load_observer(f"http:\n  listen: '{host}:80'\n", "a.yaml").http.token_file is None


@pytest.mark.parametrize(
    ("content", "mode", "problem"),
    [
        (TOKEN, 0o640, "has mode 0640"),
        (TOKEN, 0o604, "has mode 0604"),
        ("short", 0o600, "expected 16 to 512 letters and digits"),
        (TOKEN + "\nmore " + TOKEN, 0o600, "letters and digits"),
        ("é" * 20, 0o600, "letters and digits"),
        ("a" * 1000, 0o600, "letters and digits"),
    ],
)
def test_token_files_that_are_refused(
    tmp_path: Path, content: str, mode: int, problem: str
) -> None:
    file = tmp_path / "token"
    file.write_text(content, encoding="utf-8")
    file.chmod(mode)
    with pytest.raises(ConfigError, match=problem) as refused:
        read_token(file)
    assert content not in str(refused.value)


def test_token_files_that_are_taken(tmp_path: Path) -> None:
    file = tmp_path / "token"
    with pytest.raises(ConfigError, match="cannot be read"):
        read_token(file)
    file.write_text(f"{TOKEN}\n")
    for mode in (0o600, 0o400):
        file.chmod(mode)
        assert read_token(file) == TOKEN


@pytest.mark.parametrize(
    ("mode", "beside", "taken"),
    [(0o440, False, True), (0o444, False, False), (0o460, False, False), (0o440, True, False)],
)
def test_a_credential_of_systemd_may_be_read_by_its_group(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: int, beside: bool, taken: bool
) -> None:
    """systemd gives mode 0440 and an access list; such a token was refused."""
    given = tmp_path / "given"
    given.mkdir()
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(given))
    file = (tmp_path if beside else given) / "token"
    file.write_text(TOKEN)
    file.chmod(mode)
    if taken:
        assert read_token(file) == TOKEN
    else:
        with pytest.raises(ConfigError, match=f"has mode {mode:04o}"):
            read_token(file)


def request_with(access: Access, host: str = "127.0.0.1:9870", **headers: str) -> int:
    """The status that a request gets; 200 where it is served."""
    named = {name.replace("_", "-").encode(): value.encode() for name, value in headers.items()}
    denied = access.check({b"host": host.encode(), **named})
    return 200 if denied is None else denied.status


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1:9870", 200),
        ("127.0.0.1", 200),
        ("localhost:1234", 200),  # the near end of `ssh -L 1234:...`
        ("LOCALHOST.:9870", 200),
        ("[::1]:9870", 200),
        ("robot.lan", 200),
        ("rebound.example:9870", 421),
        ("127.0.0.1.rebound.example", 421),
        ("192.0.2.7:9870", 421),
        ("", 421),
        ("127.0.0.1:9870@rebound.example", 421),
        ("robot.lan.rebound.example", 421),
    ],
)
def test_names_of_a_loopback_page(host: str, status: int) -> None:
    assert request_with(Access(HOME, ["Robot.lan"], None), host) == status


def test_a_page_of_the_network_is_asked_for_by_any_address() -> None:
    access = Access(OUT, (), TOKEN)
    assert request_with(access, "192.0.2.9", authorization=f"Bearer {TOKEN}") == 200
    assert request_with(access, "rebound.example", authorization=f"Bearer {TOKEN}") == 421


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"origin": "http://127.0.0.1:9870"}, 200),
        ({"origin": "https://127.0.0.1:9870"}, 200),  # behind a proxy that ends TLS
        ({"origin": "http://127.0.0.1:1"}, 403),
        ({"origin": "http://evil.example"}, 403),
        ({"origin": "null"}, 403),
        ({"sec_fetch_site": "cross-site", "sec_fetch_mode": "no-cors"}, 403),
        ({"sec_fetch_site": "same-site", "sec_fetch_mode": "cors"}, 403),
        ({"sec_fetch_site": "cross-site", "sec_fetch_mode": "navigate"}, 200),  # a link
        ({"sec_fetch_site": "same-origin", "sec_fetch_mode": "cors"}, 200),
    ],
)
def test_foreign_origins_are_refused(headers: dict[str, str], status: int) -> None:
    assert request_with(Access(HOME, (), None), **headers) == status


def test_the_token_and_the_cookie_that_stands_for_it() -> None:
    access = Access(OUT, (), TOKEN)
    host = "192.0.2.7:9870"
    for given in ("", TOKEN, f"Bearer {TOKEN[:-1]}", f"Bearer {TOKEN}x", f"Basic {TOKEN}"):
        assert request_with(access, host, authorization=given) == 401
    assert request_with(access, host, authorization=f"bearer {TOKEN}") == 200
    assert access.cookie_for("") is None
    assert access.cookie_for(f"token={TOKEN}x") is None
    assert access.cookie_for(f"token={TOKEN}&token={TOKEN}") is None
    cookie = access.cookie_for(f"token={TOKEN}")
    pair, *attributes = cookie.split("; ")
    assert attributes == ["Path=/", "HttpOnly", "SameSite=Strict"]
    assert TOKEN not in pair
    assert request_with(access, host, cookie=f"a=b; {pair}") == 200
    assert request_with(access, host, cookie=pair[:-1]) == 401
    again, other = Access(OUT, (), TOKEN), Access(OUT, (), TOKEN[::-1])
    assert request_with(again, host, cookie=pair) == 200  # the daemon was restarted
    assert request_with(other, host, cookie=pair) == 401  # with another token
    assert Access(OUT, (), None).cookie_for(f"token={TOKEN}") is None
