"""The page of a report: whole without a network, and safe with any text."""

from html.parser import HTMLParser

import pytest

from vram_arbiter.runner.benchmark.outcomes import Cell, SeedOutcome, unplayed
from vram_arbiter.runner.benchmark.page import page

EVIL = '<script>alert("1")</script>&'
VOID = ("meta", "br")


class Reader(HTMLParser):
    """Collects elements and texts; fails where elements are not closed in turn."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert not self._open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


@pytest.mark.heavy  # the interval is SciPy's
def test_it_shows_every_seed_and_needs_nothing_else() -> None:
    evil = Cell(EVIL, EVIL, EVIL, EVIL, why=EVIL)
    evil.episodes = [
        SeedOutcome(3, True, 40, node=EVIL, video='videos/a b"#?.mp4'),
        SeedOutcome(4, False, 600),
        unplayed(5, EVIL),
    ]
    text = page({"seeds": EVIL, "latency": None}, [evil, Cell("empty", "none", None)])
    read = Reader(text)
    named = {tag for tag, _ in read.elements}
    assert not named & {"script", "link", "img", "iframe"}
    links = [attributes["href"] for tag, attributes in read.elements if tag == "a"]
    assert links == ["videos/a%20b%22%23%3F.mp4"]
    assert "http" not in text.replace("http-equiv", "")
    assert "prefers-color-scheme: dark" in text
    for said in ("1/2 = 50%, 9% to 91%", "failure", f"internal: {EVIL}", "no verdict, "):
        assert said in read.texts
    assert sum(text.strip() in ("3", "4", "5") for text in read.texts) == 3
