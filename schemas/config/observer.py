"""Configuration of `vram-observer`: where it serves the status page; hooks, which are commands and
webhooks for events of the arbiter's history.

Pure: `load_observer(text, name)` takes the text of a file. `configs/observer.yaml` shows every key.
"""

import ipaddress
from collections.abc import Mapping
from typing import Annotated, Final, Self
from urllib.parse import urlsplit

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    WithJsonSchema,
    field_validator,
    model_validator,
)

from vram_arbiter.schemas.findings import did_you_mean
from vram_arbiter.schemas.urls import http_address, request_url
from vram_arbiter.schemas.wire.notes import DAEMON_KINDS, NOTES
from vram_arbiter.schemas.yamltext import parse_yaml, validated, without_empty

EVICTED: Final = "evicted"
ALIASES: Final[Mapping[str, str]] = {"revoked": "revoke_asked", "verdict": "verified"}
"""Names of `on` beside the history's kinds; `evicted` is another one, and no single kind."""
NAMES: Final = (*NOTES, *DAEMON_KINDS, *ALIASES, EVICTED)

EventName = Annotated[str, WithJsonSchema({"type": "string", "enum": sorted(NAMES)})]
EventNames = Annotated[tuple[EventName, ...], Field(min_length=1, max_length=64)]
Seconds = Annotated[float, Field(gt=0, le=600, allow_inf_nan=False)]
Argument = Annotated[str, Field(max_length=4096)]
HostName = Annotated[str, Field(pattern=r"^[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?$")]
LISTEN: Final = "127.0.0.1:9870"


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)


class HttpConfig(_Section):
    """Status page and /metrics: read-only."""

    listen: str | None = LISTEN
    """Address: `127.0.0.1:9870`, `[::1]:9870`, or a port alone for 127.0.0.1; port 0: any free one,
    said in the log. Another address than loopback needs `token_file`. Null: no page and no
    metrics, hooks and OTLP alone."""
    token_file: Annotated[str, Field(pattern="^/")] | None = None
    """File of mode 0600 with the token that every request has to show. Null: no token, which only
    loopback may do without."""
    hosts: Annotated[tuple[HostName, ...], Field(max_length=16)] = ()
    """Names under which clients reach the page, beside addresses and localhost. A request under
    another name is refused (DNS rebinding)."""

    @field_validator("listen")
    @classmethod
    def _an_address(cls, value: str | None) -> str | None:
        return None if value is None else str(http_address(value))

    @model_validator(mode="after")
    def _token_beyond_loopback(self) -> Self:
        if self.listen is None or self.token_file is not None:
            return self
        address = http_address(self.listen)
        if not address.loopback:
            raise ValueError(
                f"{address} is not a loopback address: the page needs http.token_file there; or "
                f"listen on 127.0.0.1 and reach it by `ssh -L {address.port}:127.0.0.1:"
                f"{address.port}`"
            )
        return self


class Hook(_Section):
    """One rule: which events, and what they start. Exactly one of `command` and `webhook`."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")]
    """Name of the rule in logs and for `vram-observer --test-hook`."""
    on: Annotated[tuple[str, ...], Field(min_length=1, max_length=64)]
    """Kinds of events, as `vramctl history --kind` has them, or `revoked`, `evicted`, `verdict`.
    One name, or a list."""
    consumer: Annotated[str, Field(min_length=1, max_length=256)] = "*"
    """Glob of consumers: `detector*`. `*`: events without a consumer as well."""
    command: Annotated[tuple[Argument, ...], Field(min_length=1, max_length=256)] | None = None
    """Program and arguments, started without a shell. The event is JSON on its stdin and in its
    environment."""
    webhook: str | None = None
    """URL that gets the event as JSON by POST."""
    headers_file: Annotated[str, Field(pattern="^/")] | None = None
    """File with headers of the webhook, `Name: value` a line, such as a token. Not readable by
    other users. Read before each request."""
    timeout_s: Seconds = 10.0
    """Longest run of a command, then SIGTERM, SIGKILL after 5 s more; longest wait for the answer
    of a webhook."""
    attempts: Annotated[int, Field(ge=1, le=20)] = 5
    """Requests of a webhook in all, with growing pauses, until an answer is a success or says that
    repeating is useless."""
    concurrency: Annotated[int, Field(ge=1, le=16)] = 1
    """Runs of this rule at a time. With 1 they keep the order of the events."""
    queue_max: Annotated[int, Field(ge=1, le=1000)] = 100
    """Events that wait for this rule. Beyond it the oldest are dropped and counted."""

    @field_validator("on", mode="before", json_schema_input_type=EventName | EventNames)
    @classmethod
    def _one_or_more(cls, value: object) -> object:
        return (value,) if isinstance(value, str) else value

    @field_validator("on")
    @classmethod
    def _known(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for name in value:
            if name not in NAMES:
                raise ValueError(f"{name!r} is not an event{did_you_mean(name, NAMES)}")
        return value

    @field_validator("webhook")
    @classmethod
    def _a_webhook(cls, value: str | None) -> str | None:
        expected = "the URL of a webhook such as https://HOST/PATH"
        return None if value is None else request_url(value, expected)

    @model_validator(mode="after")
    def _one_action(self) -> Self:
        if (self.command is None) == (self.webhook is None):
            raise ValueError(f"{self.name}: expected one of `command` and `webhook`")
        if self.command is not None:
            idle = {"headers_file", "attempts"} & self.model_fields_set
            if idle:
                raise ValueError(f"{self.name}: {', '.join(sorted(idle))} is for a webhook only")
        elif self.headers_file is not None and not _is_private(str(self.webhook)):
            raise ValueError(
                f"{self.name}: headers_file would be sent in the clear over http; write https"
            )
        return self


class ObserverConfig(_Section):
    """Everything that `vram-observer` can be told; no key is required."""

    http: HttpConfig = HttpConfig()
    hooks: Annotated[tuple[Hook, ...], Field(max_length=64)] = ()
    """Rules; an event starts every one that it matches."""

    @model_validator(mode="after")
    def _unique(self) -> Self:
        names = [hook.name for hook in self.hooks]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"two hooks are named {', '.join(twice)}")
        return self


def load_observer(text: str, name: str) -> ObserverConfig:
    """Read the text of a configuration file. Raises ConfigError with every mistake and its line."""
    return validated(ObserverConfig, without_empty(ObserverConfig, parse_yaml(text, name)))


def _is_private(url: str) -> bool:
    """Whether what is sent to a URL cannot be read on its way."""
    parts = urlsplit(url)
    try:
        here = ipaddress.ip_address(parts.hostname or "").is_loopback
    except ValueError:
        here = parts.hostname == "localhost"
    return parts.scheme == "https" or here
