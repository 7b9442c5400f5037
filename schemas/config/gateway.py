"""Configuration of `vram-gateway`: where it listens, its API keys, and the model servers behind it.

Pure: `load_gateway(text, name)` and `load_keys(text, name)` take the texts of files.
"""

from typing import Annotated, Final, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, SecretStr, field_validator, model_validator

from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.limits import CONTAINER_NAME, UNIT_NAME
from vram_arbiter.schemas.units import ByteSize
from vram_arbiter.schemas.urls import http_address
from vram_arbiter.schemas.yamltext import parse_yaml, validated, without_empty

LISTEN: Final = "127.0.0.1:8000"
PRIORITY: Final = 40
"""Of servers, as of `vramctl run`: below the 50 of a robot's models."""
PARALLEL_MAX: Final = 1024
RESIDENCY_MIN_S: Final = 0.25
"""Time for the request that a server was started for to begin. Of three servers that could be
evicted earlier, none ever answered."""
OnEvict = Literal["stop", "http", "vllm", "ollama", "llama.cpp", "comfyui", "cuda-checkpoint"]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
Model = Annotated[str, Field(min_length=1, max_length=256)]
Seconds = Annotated[float, Field(gt=0, le=86_400)]
UrlPath = Annotated[str, Field(pattern=r"^/[!-~]*$", max_length=1024)]
Absolute = Annotated[str, Field(pattern="^/")]
Argument = Annotated[str, Field(max_length=4096)]
Variable = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]


class _Section(BaseModel):
    model_config = ConfigDict(
        frozen=True, extra="forbid", use_attribute_docstrings=True, allow_inf_nan=False
    )


class ServerConfig(_Section):
    """One model server, started for the first request: a `command`, a `unit` or a `container`."""

    command: Annotated[tuple[Argument, ...], Field(max_length=256)] = ()
    """Program and arguments, a child of the gateway, started without a shell. `{port}` stands for
    the port on which it shall listen on 127.0.0.1."""
    unit: Annotated[str, Field(pattern=UNIT_NAME)] | None = None
    """Name of a service of the user's systemd, else of the machine's. It needs `port`."""
    container: Annotated[str, Field(pattern=CONTAINER_NAME)] | None = None
    """Name of a container of podman or docker, which exists. It needs `port`."""
    vram: ByteSize | None = None
    """Bytes that it takes at its peak. Null, for a command: those of its entry in
    `footprints_file`."""
    models: Annotated[tuple[Model, ...], Field(max_length=256)] = ()
    """Names that clients ask for, beside the server's own."""
    on_evict: OnEvict = "stop"
    """What frees its memory when it is evicted. `stop`: it is ended, and started by the next
    request. Others: as `vramctl run --on-evict` has them; it lives on."""
    free_path: UrlPath | None = None
    """`http` only: the path that frees, by POST."""
    restore_path: UrlPath | None = None
    """`http` only: the path that restores, by POST."""
    action_timeout_s: Seconds = 60.0
    """Longest time of freeing, and of restoring."""
    park: ByteSize | None = None
    """Host RAM that it keeps while it sleeps. Null: as `vram` for `vllm` and `cuda-checkpoint`,
    else 0."""
    port: Annotated[int, Field(ge=1, le=65_535)] | None = None
    """Port of 127.0.0.1 on which it listens. Null: a free one each time, which the command has to
    name by `{port}`."""
    env: Annotated[dict[Variable, Argument], Field(max_length=256)] = Field(default_factory=dict)
    """Variables of its environment, beside the gateway's own. `{port}` as in the command."""
    health: UrlPath = "/health"
    """Path that answers 200 once it can serve."""
    start_s: Seconds = 600.0
    """Longest time from its start until `health` answers; then it has failed."""
    upstream_key_file: Absolute | None = None
    """File of mode 0600 with the API key that the server itself asks for: sent as `Authorization:
    Bearer` in place of the client's own."""
    gpu: Annotated[str, Field(min_length=1, max_length=128)] = "any"
    """UUID, index or `any`."""
    priority: Annotated[int, Field(ge=0, le=d.PRIORITY_MAX)] = PRIORITY
    """Priority of its lease. Servers of one priority take turns."""
    min_residency_s: Annotated[float, Field(ge=RESIDENCY_MIN_S, le=86_400)] = d.MIN_RESIDENCY_S
    """Seconds after its load in which it is not evicted."""
    idle_s: Seconds | None = None
    """It leaves after so long without a request. Null: it stays until another needs the room."""
    parallel: Annotated[int, Field(ge=1, le=PARALLEL_MAX)] = 32
    """Requests in flight at a time; others wait."""
    queue_max: Annotated[int, Field(ge=1, le=100_000)] = 256
    """Requests that wait at a time; one more is answered 503."""
    wait_s: Seconds = 600.0
    """Longest wait of a request; then it is answered 503."""
    grace_s: Seconds = 300.0
    """After an eviction began: how long requests in flight may go on, and how long it may take to
    end after SIGTERM."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.free_path is not None) != (self.on_evict == "http"):
            raise ValueError("free_path goes with on_evict: http, and on_evict: http with it")
        if self.restore_path is not None and self.on_evict != "http":
            raise ValueError("restore_path goes with on_evict: http")
        if sum(map(bool, (self.command, self.unit, self.container))) != 1:
            raise ValueError("expected one of `command`, `unit` and `container`")
        if self.env and not self.command:
            raise ValueError("env: a unit or container has an environment of its own")
        given = (*self.command[1:], *self.env.values())
        if self.port is None and not any("{port}" in one for one in given):
            raise ValueError("expected `port`, or `{port}` in the command: where does it listen?")
        if self.vram == 0 or (self.vram is None and not self.command):
            raise ValueError("vram: expected a size above 0, such as 6GiB")
        return self


class ClientLimits(_Section):
    """What clients may take of the gateway itself."""

    body_max_bytes: Annotated[ByteSize, Field(ge=1024, le=1 << 34)] = 256 << 20
    """Largest body that is routed by its model, by its Content-Length, or as far as it is held in
    memory: up to its `model`. What follows passes through."""
    held_max_bytes: Annotated[ByteSize, Field(ge=1 << 16, le=1 << 34)] = 512 << 20
    """Bytes of bodies that all waiting requests together hold in memory."""
    header_max_bytes: Annotated[ByteSize, Field(ge=1024, le=1 << 20)] = 16 << 10
    """Longest request line, and longest header."""
    head_s: Seconds = 30.0
    """Longest time for a request's head to arrive, and longest silence of a body and of a
    kept-alive connection."""
    connections_per_peer: Annotated[int, Field(ge=1, le=65_536)] = 2048
    """Connections of one address at a time."""


class GatewayConfig(_Section):
    """Everything that `vram-gateway` can be told."""

    listen: str = LISTEN
    """Address: `127.0.0.1:8000`, `[::1]:8000`, or a port alone for 127.0.0.1; port 0: any free
    one. Another address than loopback needs `keys_file`."""
    keys_file: Absolute | None = None
    """YAML file of mode 0600 with the API keys. Null: no keys, which only loopback may do
    without."""
    footprints_file: Absolute = "/etc/vram-arbiter/footprints.yaml"
    """YAML file of what `vramctl calibrate --name SERVER` printed, for servers without `vram`."""
    keep_alive_s: Seconds | None = None
    """A request with `stream: true` that waits is answered 200 and gets a comment line
    (server-sent events) this often, so that its client does not time out; a failure is an `error`
    event then. Null: nothing is answered before the server does."""
    limits: ClientLimits = ClientLimits()
    servers: Annotated[dict[Name, ServerConfig], Field(min_length=1, max_length=256)]
    """Model servers by name."""

    @field_validator("listen")
    @classmethod
    def _an_address(cls, value: str) -> str:
        return str(http_address(value))

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        address = http_address(self.listen)
        if not address.loopback and self.keys_file is None:
            raise ValueError(
                f"{address} is not a loopback address: it needs keys_file; or listen on 127.0.0.1"
            )
        seen: dict[str, str] = {}
        for name, server in self.servers.items():
            for model in {name, *server.models}:
                if (other := seen.setdefault(model, name)) != name:
                    raise ValueError(f"the model {model!r} is both {other}'s and {name}'s")
        return self


class Key(_Section):
    """One API key, which clients send as `Authorization: Bearer KEY` or `x-api-key: KEY`."""

    name: Name
    """Shown in place of the key."""
    key: Annotated[SecretStr, Field(min_length=16, max_length=512)]
    """The key itself."""
    servers: Annotated[tuple[Name, ...], Field(max_length=256)] | None = None
    """Servers that it may use. Null: all."""
    priority: Annotated[int, Field(ge=0, le=d.PRIORITY_MAX)] = d.PRIORITY
    """Requests of a higher priority are first in a server's queue."""
    reserve: Annotated[int, Field(ge=0, le=PARALLEL_MAX)] = 0
    """Of a server's `parallel`, so many requests are kept for this key."""


class KeysConfig(_Section):
    """The file of keys."""

    keys: Annotated[tuple[Key, ...], Field(min_length=1, max_length=1024)]
    """All keys."""

    @model_validator(mode="after")
    def _unique(self) -> Self:
        for what in ("name", "key"):
            values = [getattr(key, what) for key in self.keys]
            if len(set(values)) < len(values):
                raise ValueError(f"two keys have the same {what}")
        return self


def load_gateway(text: str, name: str) -> GatewayConfig:
    """Read the text of a configuration file. Raises ConfigError with every mistake and its line."""
    return validated(GatewayConfig, without_empty(GatewayConfig, parse_yaml(text, name)))


def load_keys(text: str, name: str) -> KeysConfig:
    """Read the text of a file of keys. Raises ConfigError with every mistake and its line."""
    return validated(KeysConfig, parse_yaml(text, name))
