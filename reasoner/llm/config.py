"""Configuration of a language model, from the environment."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.urls import http_url

TIMEOUT_S = 60.0
BUSY_S = 240.0  # for a busy server to find time, all pauses and refusals together
MAX_TOKENS = 4096  # a model that thinks first needs a thousand for that
PREFIX = "VRAM_REASONER_LLM_"


@dataclass(frozen=True, slots=True)
class LlmConfig:
    """Where the model is.

    `timeout_s` bounds one request, `busy_s` how long a busy server is asked again, `max_tokens` an
    answer with what the model thinks before it.
    """

    base_url: str
    model: str
    api_key: str = ""
    timeout_s: float = TIMEOUT_S
    max_tokens: int = MAX_TOKENS
    busy_s: float = BUSY_S

    @classmethod
    def from_environ(cls, environ: Mapping[str, str], *, base_url: str = "") -> Self:
        """Read `VRAM_REASONER_LLM_{BASE_URL,MODEL,API_KEY,TIMEOUT_S,MAX_TOKENS,BUSY_S}`.

        `base_url` is the backend's default. Raises ConfigError for missing or senseless values.
        """
        url = environ.get(PREFIX + "BASE_URL") or base_url
        missing = [
            PREFIX + name
            for name, given in (("BASE_URL", url), ("MODEL", environ.get(PREFIX + "MODEL")))
            if not given
        ]
        if missing:
            raise ConfigError(
                f"{' and '.join(missing)} not set", hint="export them, or use the scripted planner"
            )
        try:
            http_url(url, "an http(s) address")
        except ValueError as error:
            raise ConfigError(f"{PREFIX}BASE_URL: {error}") from None
        return cls(
            url.rstrip("/"),
            environ[PREFIX + "MODEL"],
            _key(environ),
            _number(environ, "TIMEOUT_S", TIMEOUT_S, "seconds"),
            int(_number(environ, "MAX_TOKENS", MAX_TOKENS, "tokens", least=1.0)),
            _number(environ, "BUSY_S", BUSY_S, "seconds"),
        )


def _key(environ: Mapping[str, str]) -> str:
    """Return the key without the white space that a file has around it.

    Raises ConfigError for a key that a header cannot carry: an HTTP library would print it.
    """
    key = environ.get(PREFIX + "API_KEY", "").strip()
    if not (key.isascii() and all(letter.isprintable() for letter in key)):
        raise ConfigError(
            f"{PREFIX}API_KEY has characters that no key has", hint="printable ASCII on one line"
        )
    return key


def _number(
    environ: Mapping[str, str], name: str, default: float, what: str, least: float = 0.0
) -> float:
    text = environ.get(PREFIX + name) or str(default)
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and number > 0 and number >= least):
        raise ConfigError(f"{PREFIX}{name}: expected a number of {what}, got {text!r}")
    return number
