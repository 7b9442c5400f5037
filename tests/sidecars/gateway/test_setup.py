"""What `vram-gateway setup` finds, and what it writes of that. `systemctl`, `docker` and `podman`
are small programs on PATH; servers are real ports with the answers of the projects' own endpoints.
The whole command runs in tests/packaging/test_units_start.py."""

import json
import os
import stat
import threading
from collections.abc import Iterator, Mapping
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from tests.support.process import ArbiterProcess
from vram_arbiter.clients.cli.installation.site import Site, site_of_user
from vram_arbiter.schemas.config.gateway import load_gateway, load_keys
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.errors import ArbiterUnreachable, ConfigError
from vram_arbiter.schemas.runtime import procfs
from vram_arbiter.sidecars.gateway import setup
from vram_arbiter.sidecars.gateway.__main__ import main
from vram_arbiter.sidecars.gateway.setup import Found, FoundServer, config_text

KEYS_FILE = Path("/etc/vram-arbiter/gateway-keys.yaml")
GPU = {"gpu": "GPU-0", "name": "RTX", "capacity_bytes": 8 * GIB, "processes": []}
OLLAMA = FoundServer(
    "ollama", "unit", "ollama.service", 11434, on_evict="ollama", held_bytes=3 * GIB
)
ENDPOINT = "ipc:///run/vram-arbiter/arbiter.sock"
EXEC = "{{ path={0} ; argv[]={1} ; ignore_errors=no ; start_time=[n/a] }}"


@pytest.fixture
def path_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that is the whole PATH, with `cat` and `echo` of the shell alone."""
    monkeypatch.setenv("PATH", str(tmp_path))
    return tmp_path


def write_program(folder: Path, name: str, text: str) -> None:
    (folder / name).write_text(f"#!/bin/sh\n{text}")
    (folder / name).chmod(0o755)


def test_listening_ports_are_those_of_both_families(tmp_path: Path) -> None:
    (tmp_path / "net").mkdir()
    head = "  sl  local_address rem_address   st\n"
    (tmp_path / "net/tcp").write_text(
        f"{head}   0: 0100007F:1F40 00000000:0000 0A 0\n   1: 0100007F:1F41 0100007F:9999 01 0\n"
    )
    assert setup.listening(tmp_path) == {8000}
    line = f"   0: {'0' * 32}:2CAA {'0' * 32}:0000 0A 0\n"
    (tmp_path / "net/tcp6").write_text(head + line)
    assert setup.listening(tmp_path) == {8000, 11434}


def test_units_that_start_a_model_server_are_found_by_their_command(path_folder: Path) -> None:
    shown = "\n\n".join(
        f"Id={name}\nExecStart={EXEC.format(command.split()[0], command)}\nControlGroup={cgroup}"
        for name, command, cgroup in (
            ("ollama.service", "/usr/local/bin/ollama serve", "/system.slice/ollama.service"),
            ("qwen.service", "/opt/v/bin/vllm serve Qwen/Q --port 8007 --enable-sleep-mode", ""),
            ("router.service", "/usr/bin/llama-server --port=9000", ""),
            ("comfy.service", "/opt/c/bin/python /opt/ComfyUI/main.py", ""),
            ("ssh.service", "/usr/sbin/sshd -D", "/system.slice/ssh.service"),
            ("leased.service", "/usr/bin/vramctl run --vram 1GiB -- vllm serve m", ""),
        )
    )
    listed = "ollama.service enabled\nvllm@.service static\nssh.service enabled\n"
    write_program(
        path_folder, "systemctl",
        f"case $* in *list-unit-files*) echo '{listed}' ;; *) echo '{shown}' ;; esac\n",
    )  # fmt: skip
    found = {one.name: (one.kind, one.where, one.port) for one in setup.units()}
    assert found == {
        "ollama.service": ("ollama", "unit", 11434),
        "qwen.service": ("vllm", "unit", 8007),
        "router.service": ("llama.cpp", "unit", 9000),
        "comfy.service": ("comfyui", "unit", 8188),
    }
    assert setup.units()[0].cgroup == "/system.slice/ollama.service"


def test_containers_are_found_by_image_and_command_with_their_outer_port(path_folder: Path) -> None:
    def told(name: str, image: str, *words: str, outside: str = "") -> dict[str, Any]:
        bound = {"8000/tcp": [{"HostIp": "127.0.0.1", "HostPort": outside}]} if outside else None
        return {
            "Name": name, "State": {"Pid": 0}, "HostConfig": {"PortBindings": bound},
            "Config": {"Image": image, "Cmd": list(words) or None, "Entrypoint": None},
        }  # fmt: skip

    inspected = [
        told("/big", "vllm/vllm-openai:v0.11", "--model", "x", outside="8012"),
        told("/host", "docker.io/ollama/ollama"),
        told("/web", "nginx", outside="80"),
    ]
    write_program(
        path_folder, "docker",
        f"[ $2 = ls ] && echo a b c || echo '{json.dumps(inspected)}'\n",
    )  # fmt: skip
    assert [(one.name, one.kind, one.port) for one in setup.containers()] == [
        ("big", "vllm", 8012),
        ("host", "ollama", 11434),
    ]


def test_a_machine_without_systemd_and_engines_has_none(path_folder: Path) -> None:
    write_program(path_folder, "systemctl", "exit 1\n")
    assert (setup.units(), setup.containers()) == ([], [])


ANSWERS: Mapping[str, Mapping[str, str]] = {
    "vllm": {
        "/v1/models": '{"data": [{"id": "Qwen/Q", "owned_by": "vllm"}]}',
        "/is_sleeping": '{"is_sleeping": false}',
    },
    "llama.cpp": {"/v1/models": '{"data":[{"id":"q.gguf","owned_by":"llamacpp"}]}'},
    "ollama": {
        "/": "Ollama is running",
        "/api/tags": '{"models": [{"name": "q:4b", "model": "q:4b"}]}',
        "/v1/models": '{"data": [{"id": "q:4b", "owned_by": "library"}]}',
    },
    "comfyui": {"/system_stats": '{"system": {"comfyui_version": "0.3"}}'},
    "": {"/": "It works!", "/v1/models": '{"data": [{"id": "gpt", "owned_by": "me"}]}'},
}


@pytest.fixture
def answering(request: pytest.FixtureRequest) -> Iterator[int]:
    """The port of a server with these answers."""
    answers: Mapping[str, str] = request.param

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            body = answers.get(self.path, "").encode()
            self.send_response(200 if body else 404)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            """Nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        yield server.server_port
        server.shutdown()


@pytest.mark.parametrize(
    ("answering", "kind", "on_evict", "models"),
    [
        (ANSWERS["vllm"], "vllm", "vllm", ("Qwen/Q",)),
        ({**ANSWERS["vllm"], "/is_sleeping": ""}, "vllm", "stop", ("Qwen/Q",)),
        (ANSWERS["llama.cpp"], "llama.cpp", "stop", ("q.gguf",)),
        (
            {**ANSWERS["llama.cpp"], "/models": '{"data":[{"id":"q","status":{}}]}'},
            "llama.cpp",
            "llama.cpp",
            ("q.gguf",),
        ),
        (ANSWERS["ollama"], "ollama", "ollama", ("q:4b",)),
        (ANSWERS["comfyui"], "comfyui", "comfyui", ()),
        (ANSWERS[""], "", "stop", ()),
    ],
    indirect=["answering"],
)
def test_a_server_is_what_its_endpoints_say(
    answering: int, kind: str, on_evict: str, models: tuple[str, ...]
) -> None:
    found = setup.asked(FoundServer("", "pid", "", answering))
    assert (found.kind, found.on_evict, found.models) == (kind, on_evict, models)


def test_a_server_that_was_started_by_hand_is_found_by_its_command_line(tmp_path: Path) -> None:
    (tmp_path / "77").mkdir()
    (tmp_path / "77/cmdline").write_bytes(b"/v/bin/vllm\0serve\0m\0--port\0" + b"9001\0")
    (tmp_path / "net").mkdir()
    found = setup.by_hand({8188}, {9001, 8188, 11434, 22}, tmp_path)
    assert {(one.port, one.pid) for one in found} == {(9001, 77), (11434, 0)}


def test_bytes_are_those_of_the_cgroup_or_the_process() -> None:
    own = procfs.read_cgroup(os.getpid())
    use = {"pid": os.getpid(), "used_bytes": 3 * GIB}
    gpus = [{**GPU, "processes": [{"pid": 1, "used_bytes": 1}]}, {"gpu": "G1", "processes": [use]}]
    by_pid = setup.measured(replace(OLLAMA, held_bytes=0, pid=os.getpid()), gpus)
    assert (by_pid.held_bytes, by_pid.gpu) == (3 * GIB, "G1")
    if own != "/":
        by_cgroup = setup.measured(replace(OLLAMA, held_bytes=0, cgroup=own), gpus)
        assert by_cgroup.held_bytes >= 3 * GIB
    none = setup.measured(replace(OLLAMA, held_bytes=0, cgroup="/nowhere"), gpus)
    assert (none.held_bytes, none.gpu) == (0, None)


# -- the file
def test_the_file_has_what_is_known_and_comments_for_the_rest() -> None:
    vllm = FoundServer(
        "vllm", "container", "big", 8000, held_bytes=5 * GIB + 1, models=("Q", "ollama")
    )
    hand = FoundServer("llama.cpp", "pid", "llama.cpp", 8080, "llama-server -m x", held_bytes=GIB)
    cold = FoundServer("comfyui", "unit", "comfy.service", 8188)
    twin = replace(OLLAMA, where="container", name="ollama", port=11435)
    servers = [OLLAMA, vllm, hand, cold, twin]
    text = config_text(
        Found([GPU], servers, frozenset({8001}), ["vllm", "comfy", "ollama"]), KEYS_FILE
    )
    config = load_gateway(text, "gateway.yaml")
    assert config.listen == "127.0.0.1:8002", "8000 and 8001 are others'"
    assert config.keys_file == str(KEYS_FILE)
    assert list(config.servers) == ["ollama", "big", "ollama-2"]
    ollama, big = config.servers["ollama"], config.servers["big"]
    assert (ollama.unit, ollama.port, ollama.vram, ollama.on_evict, ollama.health, ollama.gpu) == (
        "ollama.service", 11434, 3 * GIB, "ollama", "/", "any",
    )  # fmt: skip
    assert (big.container, big.vram, big.models) == ("big", 5 * GIB + (64 << 20), ("Q",))
    comments = [line for line in text.splitlines() if line.startswith("#")]
    assert "# GPU: RTX (8 GiB)" in comments
    assert any(
        "is neither a unit nor a container" in line and "llama-server -m x" in line
        for line in comments
    )
    assert any(
        line.startswith("# comfy: ") and "nothing of it is on a GPU" in line for line in comments
    )
    assert not [line for line in comments if "is installed" in line], "all three were found"


def test_names_of_others_stay_inside_their_comment() -> None:
    hostile = FoundServer(
        "vllm", "pid", "vllm", 8000, "vllm serve\nservers: {evil: {}}", held_bytes=GIB
    )
    text = config_text(Found([GPU], [OLLAMA, hostile], frozenset(), ["comfy"]), KEYS_FILE)
    assert list(load_gateway(text, "gateway.yaml").servers) == ["ollama"]
    assert "# comfy is installed: add a `command` for it" in text


def test_with_several_gpus_each_server_names_its_own() -> None:
    found = Found([GPU, {**GPU, "gpu": "GPU-1"}], [replace(OLLAMA, gpu="GPU-1")], frozenset())
    assert load_gateway(config_text(found, KEYS_FILE), "x").servers["ollama"].gpu == "GPU-1"


# -- writing and starting
@pytest.fixture
def site(path_folder: Path) -> Site:
    home = path_folder / "config"
    return replace(site_of_user({"XDG_CONFIG_HOME": str(home), "XDG_RUNTIME_DIR": str(home)}))


def text_for(site: Site) -> str:
    return config_text(Found([GPU], [OLLAMA], frozenset()), site.settings / "gateway-keys.yaml")


def test_files_are_private_a_unit_is_written_and_nothing_is_overwritten(
    site: Site, path_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_program(path_folder, "systemctl", f"echo $* >>{path_folder}/calls; echo Version=252\n")
    assert setup.install(site, text_for(site), ENDPOINT, force=False) == 0
    path, keys = site.settings / "gateway.yaml", site.settings / "gateway-keys.yaml"
    assert (site.settings / "gateway.env").read_text() == f"VRAM_ARBITER_ENDPOINT={ENDPOINT}\n"
    assert [stat.S_IMODE(one.stat().st_mode) for one in (path, keys)] == [0o600, 0o600]
    (key,) = load_keys(keys.read_text(), "keys").keys
    said = capsys.readouterr().out.splitlines()
    assert said[1:] == [
        "http://127.0.0.1:8000",
        "export OPENAI_BASE_URL=http://127.0.0.1:8000/v1",
        f"export OPENAI_API_KEY={key.key.get_secret_value()}",
    ]
    assert "vram-gateway serve --config %E" in (site.units / setup.UNIT).read_text()
    assert (path_folder / "calls").read_text().splitlines()[1:] == [
        "--user daemon-reload",
        f"--user enable {setup.UNIT}",
        f"--user restart {setup.UNIT}",
    ]
    away = Found([GPU], [replace(OLLAMA, held_bytes=0)], frozenset({8000}))
    kept = setup.with_kept(away, path)
    assert (kept.servers, kept.listen) == ([OLLAMA], "127.0.0.1:8000"), "it is the gateway there"
    assert config_text(kept, keys) == text_for(site)
    assert setup.with_kept(away, keys.with_name("none")) == away
    with pytest.raises(ConfigError, match=r"gateway\.yaml exists") as refused:
        setup.install(site, text_for(site), ENDPOINT, force=False)
    assert "--force" in str(refused.value.hint)
    assert setup.install(site, text_for(site), ENDPOINT, force=True) == 0
    (same,) = load_keys(keys.read_text(), "keys").keys
    assert same == key, "clients show it already"


def test_without_systemd_it_says_how_to_serve(
    site: Site, capsys: pytest.CaptureFixture[str]
) -> None:
    assert setup.install(site, text_for(site), ENDPOINT, force=False) == 0
    assert "systemd does not run here; start it by: vram-gateway serve" in capsys.readouterr().out


def test_without_a_server_nothing_is_written(site: Site) -> None:
    text = config_text(Found([GPU], [], frozenset()), KEYS_FILE)
    with pytest.raises(ConfigError, match="no model server was found"):
        setup.install(site, text, ENDPOINT, force=False)
    assert not site.settings.exists()


@pytest.mark.e2e
def test_a_dry_run_prints_the_file_and_changes_nothing(
    arbiter_daemon: ArbiterProcess, path_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The GPU is that of the running arbiter; no server is needed for that."""
    shown = f"Id=a.service\nExecStart={EXEC.format('/o', '/o/ollama serve')}\nControlGroup=\n"
    answers = f"case $* in *list-unit-files*) echo a.service ;; *) echo '{shown}' ;; esac"
    write_program(path_folder, "systemctl", f"echo $* >>{path_folder}/calls\n{answers}\n")
    assert main(["setup", "--dry-run", "--endpoint", arbiter_daemon.endpoint]) == 0
    said = capsys.readouterr().out
    assert "# GPU: Simulated GPU (8 GiB)" in said
    assert "# a: ollama, port 11434: nothing of it is on a GPU" in said
    assert "servers: {}" in said
    assert not [
        line for line in (path_folder / "calls").read_text().splitlines() if "enable" in line
    ]


def test_without_an_arbiter_it_says_how_to_start_it(tmp_path: Path) -> None:
    with pytest.raises(ArbiterUnreachable) as error:
        setup.looked(f"ipc://{tmp_path}/none.sock")
    assert "vramctl install" in str(error.value.hint)
