"""What a server's configuration may be, and the `vramctl run` that it becomes."""

import pytest

from vram_arbiter.schemas.config.gateway import ServerConfig, load_gateway
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.sidecars.gateway.program import arguments

ENDPOINT = "ipc:///run/arbiter.sock"


def server_config(text: str) -> ServerConfig:
    return load_gateway(f"servers: {{llm: {{vram: 2GiB, {text}}}}}", "gateway.yaml").servers["llm"]


@pytest.mark.parametrize("kind", ["unit", "container"])
def test_a_unit_or_container_takes_the_place_of_the_command(kind: str) -> None:
    words = arguments("llm", server_config(f"{kind}: llm.x, port: 8123"), 8123, ENDPOINT, 7)
    assert words[words.index(f"--{kind}") + 1] == "llm.x"
    assert words[words.index("--health") + 1] == "http://127.0.0.1:8123/health"
    assert words[-1] == "--", "no command"


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("port: 1", "expected one of `command`, `unit` and `container`"),
        ("unit: a, container: b, port: 1", "expected one of"),
        ("unit: a, command: [b], port: 1", "expected one of"),
        ("unit: a", "expected `port`"),
        ("unit: --user, port: 1", "'--user' is not"),
        ("container: a b, port: 1", "'a b' is not"),
        ("unit: a, port: 1, env: {A: b}", "an environment of its own"),
        ("unit: a, port: 1, min_residency_s: 0", "min_residency_s.*0.25"),
    ],
)
def test_anything_else_is_refused(text: str, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        server_config(text)
