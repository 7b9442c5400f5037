"""URLs in configuration files and in the environment."""

from urllib.parse import urlsplit


def collector_url(text: str) -> str:
    """Return `text`. Raises ValueError unless it is http://HOST... or https://HOST...."""
    try:
        parts = urlsplit(text)
        good = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:
        good = False
    if not good:
        shown = text.rpartition("@")[2].partition("?")[0]  # without password and token
        raise ValueError(
            f"expected the URL of a collector, got {shown!r}; write http://localhost:4318"
        )
    return text
