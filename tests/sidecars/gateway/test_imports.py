"""A configuration of llama-swap becomes the gateway's, and what does not is named."""

import argparse
import re
from pathlib import Path

import pytest

from vram_arbiter.clients.calibration.entry import entry_of, text_of
from vram_arbiter.clients.calibration.record import Figures
from vram_arbiter.schemas.config.gateway import GatewayConfig, load_gateway
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.yamltext import parse_yaml
from vram_arbiter.sidecars.gateway import imports
from vram_arbiter.sidecars.gateway.imports import Converted, convert
from vram_arbiter.sidecars.gateway.program import sized

SIZES = {"": "4GiB"}
MODELS = """
macros:
  binary: >
    /opt/llama-server --port ${PORT}
  context: 4096
  arguments: "--ctx-size ${context}"
globalTTL: 300
healthCheckTimeout: 90
sendLoadingState: true
models:
  "Qwen/Qwen3:4b":
    macros: {context: 8192}
    cmd: |
      # ${binary} is declared above
      ${binary} ${arguments} \\
      --model '${env.MODELS}/a b.gguf' --alias ${MODEL_ID}
    aliases: [gpt-4o-mini, qwen]
    env: ["CUDA_VISIBLE_DEVICES=0", "URL=http://127.0.0.1:${PORT}/a=b"]
    ttl: 0
    checkEndpoint: /ready
    concurrencyLimit: 500
  fixed:
    cmd: ${binary} ${arguments}
    proxy: http://localhost:9100
"""


def converted(text: str, **environ: str) -> Converted:
    return convert(parse_yaml(text, "swap.yaml"), SIZES, environ)


def read(text: str, **environ: str) -> GatewayConfig:
    return load_gateway(converted(text, **environ).text, "gateway.yaml")


def test_commands_names_and_limits() -> None:
    config = read(MODELS, MODELS="/models")
    assert config.keep_alive_s == imports.KEEP_ALIVE_S
    qwen, fixed = config.servers.values()
    assert list(config.servers) == ["Qwen-Qwen3-4b", "fixed"]
    assert qwen.command == (
        *("/opt/llama-server", "--port", "{port}", "--ctx-size", "8192"),
        *("--model", "/models/a b.gguf", "--alias", "Qwen/Qwen3:4b"),
    )
    assert qwen.models == ("Qwen/Qwen3:4b", "gpt-4o-mini", "qwen")
    assert qwen.env == {"CUDA_VISIBLE_DEVICES": "0", "URL": "http://127.0.0.1:{port}/a=b"}
    assert (qwen.health, qwen.parallel, qwen.idle_s) == ("/ready", 500, None)
    assert (fixed.port, fixed.idle_s, fixed.start_s) == (9100, 300, 90)
    assert fixed.command[-1] == "4096"
    assert fixed.vram == qwen.vram == 4 << 30


def test_all_of_it_is_converted() -> None:
    assert converted(MODELS, MODELS="/m").left == []


def test_what_has_no_counterpart_is_named() -> None:
    found = converted("""
apiKeys: [sk-secret-of-the-users]
logLevel: debug
peers: {other: {proxy: http://192.168.1.9, models: [x]}}
models:
  a:
    cmd: docker run -p ${PORT}:8080 image
    cmdStop: docker stop a
    checkEndpoint: none
    filters: {stripParams: top_p}
    proxy: http://127.0.0.1:${PORT}/v1
    unlisted: true
    useModelName: org/a
  elsewhere: {cmd: x, proxy: "http://192.168.1.23:8080"}
  nowhere: {cmd: some-server}
""")
    named = [one.partition(": ")[0] for one in found.left]
    assert named == [
        *("apiKeys", "logLevel", "peers"),
        *("models.a.cmdStop", "models.a.filters", "models.a.unlisted", "models.a.useModelName"),
        *("models.a.cmd", "models.a.proxy", "models.a.checkEndpoint"),
        *("models.elsewhere", "models.nowhere"),
    ]
    assert "sk-secret" not in found.text + "".join(found.left)
    assert list(load_gateway(found.text, "x").servers) == ["a"]


@pytest.mark.parametrize("place", ["top", "routing"])
def test_groups_need_nothing_but_persistent_ones_a_priority(place: str) -> None:
    groups = "groups: {llms: {swap: true, members: [a, b]}, kept: {persistent: true, members: [c]}}"
    servers = "".join(f"  {name}: {{cmd: 'run ${{PORT}}'}}\n" for name in "abc")
    fifo = "scheduler: {settings: {fifo: {priority: {a: 3}}}}"
    rules = {
        "top": f"{groups}\nrouting: {{{fifo}}}\n",
        "routing": f"routing: {{router: {{settings: {{{groups}}}}}, {fifo}}}\n",
    }[place]
    found = converted(f"{rules}models:\n{servers}")
    config = load_gateway(found.text, "x")
    assert {name: server.priority for name, server in config.servers.items()} == {
        "a": 43,
        "b": 40,
        "c": imports.ABOVE,
    }
    assert found.left == []
    assert [note.partition(":")[0] for note in found.noted] == [
        *("groups, matrix", "groups.kept.persistent", "fifo.priority.a")
    ]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("models: {a: {cmd: 'x ${PORT} ${missing}'}}", "unknown macro"),
        ("models: {a: {cmd: 'x ${PORT} ${env.MISSING}'}}", "MISSING is not set"),
        ("models: {a: {cmd: 'x ${PORT} \"'}}", "No closing quotation"),
        ("models: {a: [1]}", "models.a: expected a map"),
        ("models: {a: {cmd: 'x ${PORT}', aliases: b}}", "aliases: expected a list"),
        (
            "models: {a: {cmd: 'x ${PORT}', aliases: [b]}, b: {cmd: 'y ${PORT}'}}",
            "both a's and b's",
        ),
        ("models: {a: {cmd: 'x ${PORT}', ttl: soon}}", "ttl: expected a number"),
        ("models: {a: {cmd: 'x', proxy: 'http://127.0.0.1:99999'}}", "proxy: expected a URL"),
        ("models: {}", "servers"),
    ],
)
def test_mistakes_have_words(text: str, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        converted(text)


def test_a_size_for_one_model_and_none_for_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A file without all sizes is written, and the gateway names what is missing, and how to get
    it."""
    (tmp_path / "swap.yaml").write_text("models: {a: {cmd: 'x ${PORT}'}, b: {cmd: 'y ${PORT}'}}")
    arguments = [str(tmp_path / "swap.yaml"), "--out", str(tmp_path / "out.yaml")]
    parser = argparse.ArgumentParser()
    imports.add_arguments(parser)
    given = parser.parse_args([*arguments, "--vram", "a=2GiB", "--listen", "127.0.0.1:9000"])
    assert imports.run(given) == imports.INCOMPLETE
    assert "not converted: models.b.vram" in capsys.readouterr().err
    text = (tmp_path / "out.yaml").read_text()
    unsized = load_gateway(text + f"footprints_file: {tmp_path}/f.yaml", "out.yaml")
    with pytest.raises(ConfigError, match="b has no `vram`") as raised:
        sized(unsized)
    assert re.fullmatch(
        rf"vramctl calibrate --seconds 60 --name b -- y \d+ >>{tmp_path}/f.yaml", raised.value.hint
    )
    (tmp_path / "f.yaml").write_text(text_of("local/b", entry_of(Figures(3 << 30, 2 << 30), "t")))
    found = {name: server.vram for name, server in sized(unsized).servers.items()}
    assert found == {"a": 2 << 30, "b": (3 << 30) + (48 << 20)}, "with the margin of the record"
    with pytest.raises(ConfigError, match="exists"):
        imports.run(given)
    assert (tmp_path / "out.yaml").read_text() == text
