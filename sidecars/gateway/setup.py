"""`vram-gateway setup`: look for GPUs and model servers, write the configuration and a token, start
the service.

Looking changes nothing: `looked` asks listening servers, systemd, podman and docker, and the
arbiter; `config_text` is pure. Only files of the gateway are written, and none is overwritten
without `--force`. What cannot be decided is a comment of the file.
"""

import argparse
import http.client
import json
import os
import re
import secrets
import shutil
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import yaml

from vram_arbiter.clients.cli.installation.contents import wanted
from vram_arbiter.clients.cli.installation.site import SYSTEM, Site, site_of_user
from vram_arbiter.clients.foreign.service import said_by
from vram_arbiter.clients.net.request import ask
from vram_arbiter.schemas.config.gateway import load_gateway, load_keys
from vram_arbiter.schemas.errors import ArbiterUnreachable, ConfigError
from vram_arbiter.schemas.runtime import procfs
from vram_arbiter.schemas.runtime.endpoints import ENDPOINT_VARIABLE
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.sizes import format_bytes
from vram_arbiter.schemas.wire.requests import Status

UNIT: Final = "vram-gateway.service"
CONFIG, KEYS, ENVIRON = "gateway.yaml", "gateway-keys.yaml", "gateway.env"
ASK_S = 2.0
ANSWER_MAX_BYTES: Final = 1 << 20
MODELS_MAX: Final = 64
STEP_BYTES: Final = 64 << 20
"""Measured bytes are rounded up to a multiple of this."""
PORTS: Final = range(8000, 8100)
"""Of these the first free one is the gateway's."""
_LISTENS: Final = "0A"


@dataclass(frozen=True, slots=True)
class Kind:
    """How a kind of server is known: by its command line, and by the answer of `path`."""

    words: str
    port: int
    path: str
    mark: str
    health: str
    program: str


KINDS: Final[Mapping[str, Kind]] = {
    "vllm": Kind(
        r"vllm/vllm|vllm serve|vllm\.entrypoints", 8000, "/v1/models", '"owned_by": *"vllm"',
        "/health", "vllm",
    ),
    "llama.cpp": Kind(
        r"llama-server|llama\.cpp", 8080, "/v1/models", '"owned_by": *"llamacpp"',
        "/health", "llama-server",
    ),
    "ollama": Kind(
        r"ollama serve|ollama/ollama", 11434, "/", "Ollama is running", "/", "ollama"
    ),
    "comfyui": Kind(
        "(?i)comfyui", 8188, "/system_stats", '"comfyui_version"', "/system_stats", "comfy"
    ),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class FoundServer:
    """A model server that was found. `where`: `unit`, `container`, or `pid` of one that was started
    by hand; `held_bytes` and `gpu`: what the arbiter reads of it."""

    kind: str
    where: str
    name: str
    port: int
    command: str = ""
    cgroup: str = ""
    pid: int = 0
    on_evict: str = "stop"
    models: tuple[str, ...] = ()
    held_bytes: int = 0
    gpu: str | None = None


@dataclass(frozen=True, slots=True)
class Found:
    """Everything that was looked at. `taken`: ports on which something listens; `listen`: the
    address of a configuration that is there."""

    gpus: Sequence[Mapping[str, Any]]
    servers: Sequence[FoundServer]
    taken: frozenset[int]
    programs: Sequence[str] = ()
    listen: str = ""


# -- looking
def looked(endpoint: str | None) -> Found:
    """Return what runs and is installed. Raises ArbiterUnreachable."""
    try:
        gpus = ask(Status(), endpoint)["gpus"]
    except ArbiterUnreachable as error:
        hint = "start it first: `vramctl install` as a service, or vram-arbiter in a terminal"
        raise ArbiterUnreachable(error.message, hint=hint) from error
    taken = listening()
    named = [*units(), *containers()]
    known = {server.port for server in named}
    servers = [asked(one) if one.port in taken else one for one in [*named, *by_hand(known, taken)]]
    programs = [kind.program for kind in KINDS.values() if shutil.which(kind.program)]
    return Found(gpus, [measured(one, gpus) for one in servers if one.kind], taken, programs)


def listening(proc: Path = procfs.PROC) -> frozenset[int]:
    """Return the TCP ports of this machine on which something listens (proc_net_tcp(5))."""
    lines = [
        line.split()
        for name in ("tcp", "tcp6")
        if (proc / "net" / name).exists()
        for line in (proc / "net" / name).read_text().splitlines()[1:]
    ]
    return frozenset(int(line[1].rpartition(":")[2], 16) for line in lines if line[3] == _LISTENS)


def units() -> list[FoundServer]:
    """Return the services of systemd that start a model server: root's are the machine's, another
    user's its own."""
    control = ("systemctl", *(("--user",) if os.getuid() else ()))
    listed = said_by(*control, "list-unit-files", "--type=service", "--plain", "--no-legend")
    names = [line.split()[0] for line in listed.splitlines() if line.strip() and "@." not in line]
    asked_for = "--property=Id,ExecStart,ControlGroup"
    found = []
    for block in said_by(*control, "show", asked_for, "--", *names).split("\n\n") if names else ():
        facts = dict(line.split("=", 1) for line in block.splitlines() if "=" in line)
        command = " ".join(re.findall(r"argv\[\]=(.*?) ; ", facts.get("ExecStart", "")))
        if kind := kind_of(command):
            place = port_of(kind, command), command, facts.get("ControlGroup", "")
            found.append(FoundServer(kind, "unit", facts["Id"], *place))
    return found


def containers() -> list[FoundServer]:
    """Return the containers of podman and docker that hold a model server. Root's unit cannot run
    podman within its limits."""
    found = []
    for engine in filter(shutil.which, ("podman", "docker") if os.getuid() else ("docker",)):
        listed = said_by(engine, "container", "ls", "--all", "--quiet", "--no-trunc").split()
        said = said_by(engine, "container", "inspect", "--", *listed) if listed else ""
        for one in json.loads(said) if said else ():
            config = one["Config"]
            entry = config.get("Entrypoint") or ()
            words = [entry] if isinstance(entry, str) else [*entry]
            command = " ".join([str(config.get("Image")), *words, *(config.get("Cmd") or ())])
            pid = one["State"]["Pid"]
            if kind := kind_of(command):
                bindings = (one["HostConfig"].get("PortBindings") or {}).values()
                outside = [int(bind["HostPort"] or 0) for some in bindings for bind in some or ()]
                port = outside[0] if outside else port_of(kind, command)
                cgroup = procfs.read_cgroup(pid) if pid else ""
                name = one["Name"].lstrip("/")
                found.append(FoundServer(kind, "container", name, port, command, cgroup))
    return found


def by_hand(
    known: Iterable[int], taken: Iterable[int], proc: Path = procfs.PROC
) -> list[FoundServer]:
    """Return servers that listen, and are no unit's and no container's; `kind` is "" before they
    answered. `known`: ports of those."""
    found = {kind.port: FoundServer("", "pid", "", kind.port) for kind in KINDS.values()}
    for entry in proc.iterdir():
        try:
            command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue
        if entry.name.isdecimal() and (kind := kind_of(command)):
            port = port_of(kind, command)
            found[port] = FoundServer("", "pid", kind, port, command.strip(), pid=int(entry.name))
    return [server for port, server in found.items() if port in taken and port not in known]


def asked(server: FoundServer) -> FoundServer:
    """Return a server that listens, by what its own endpoints say. A port that answers as no kind
    is another program's."""
    kinds = [server.kind] if server.kind else list(KINDS)
    for kind in kinds:
        if not re.search(KINDS[kind].mark, _got(server.port, KINDS[kind].path)):
            continue
        models = _got(server.port, "/api/tags" if kind == "ollama" else "/v1/models")
        names = re.findall(r'"(?:id|model)": *"([^"]+)"', models)[:MODELS_MAX]
        sleeps = {
            "vllm": "is_sleeping" in _got(server.port, "/is_sleeping"),
            "llama.cpp": '"status"' in _got(server.port, "/models"),  # a router
        }.get(kind, True)
        name, on_evict = server.name or kind, kind if sleeps else "stop"
        return replace(
            server, kind=kind, name=name, models=tuple(dict.fromkeys(names)), on_evict=on_evict
        )
    return server


def measured(server: FoundServer, gpus: Sequence[Mapping[str, Any]]) -> FoundServer:
    """Return a server with the bytes of its processes, on the GPU that has most of them."""
    held: dict[str, int] = {}
    for gpu in gpus:
        for process in gpu["processes"]:
            inside = procfs.read_cgroup(process["pid"]) + "/"
            if process["pid"] == server.pid or (
                server.cgroup and inside.startswith(f"{server.cgroup}/")
            ):
                held[gpu["gpu"]] = held.get(gpu["gpu"], 0) + (process["used_bytes"] or 0)
    most = max(held, key=lambda gpu: held[gpu], default=None)
    return server if most is None else replace(server, held_bytes=held[most], gpu=most)


def kind_of(command: str) -> str:
    """Return the kind of a command line; "" for another program's, and for one under a lease."""
    kinds = () if "vramctl run" in command else KINDS.items()
    return next((name for name, kind in kinds if re.search(kind.words, command)), "")


def port_of(kind: str, command: str) -> int:
    given = re.search(r"--port[= ](\d{1,5})\b", command)
    return int(given[1]) if given else KINDS[kind].port


def _got(port: int, path: str) -> str:
    """Return the body of an answer of 127.0.0.1; "" where there is none."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=ASK_S)
    try:
        connection.request("GET", path)
        answer = connection.getresponse()
        return (
            answer.read(ANSWER_MAX_BYTES).decode(errors="replace") if answer.status == 200 else ""
        )
    except (OSError, http.client.HTTPException):
        return ""
    finally:
        connection.close()


# -- the file
def config_text(found: Found, keys_file: Path) -> str:
    """Return gateway.yaml. A server that cannot be configured is a comment with the reason."""
    used = {server.port for server in found.servers} | found.taken
    port = next(port for port in PORTS if port not in used)
    listen = found.listen or f"127.0.0.1:{port}"
    gpus = [f"{gpu['name']} ({format_bytes(gpu['capacity_bytes'])})" for gpu in found.gpus]
    lines = ["Written by `vram-gateway setup`.", *(f"GPU: {gpu}" for gpu in gpus)]
    config: dict[str, Any] = {"listen": listen, "keys_file": str(keys_file)}
    servers: dict[str, Any] = {}
    models: set[str] = set()
    for server in found.servers:
        name = _free_name(server.name, servers)
        told = f"{name}: {server.kind}, port {server.port}"
        if server.where == "pid":
            what = "is neither a unit nor a container that this gateway may start"
            lines.append(f"{told}, {what}: make it one, or a `command` ({server.command})")
        elif not server.held_bytes:
            lines.append(f"{told}: nothing of it is on a GPU; start it, and run setup again")
        else:
            own = [model for model in server.models if model not in {name, *models}]
            models |= {name, *own}
            steps = -(-server.held_bytes // STEP_BYTES)
            servers[name] = {
                server.where: server.name,
                "port": server.port,
                "vram": f"{steps * (STEP_BYTES >> 20)}MiB",
                "on_evict": server.on_evict,
                "health": KINDS[server.kind].health,
                **({"models": own} if own else {}),
                **({"gpu": server.gpu} if len(found.gpus) > 1 else {}),
            }
            lines.append(f"{told}: holds {format_bytes(server.held_bytes)} now; `vram` is its peak")
    running = {server.kind for server in found.servers}
    absent = [
        one for one in found.programs if not any(KINDS[kind].program == one for kind in running)
    ]
    lines += [f"{program} is installed: add a `command` for it" for program in absent]
    comments = "".join(f"# {printable(line)}\n" for line in lines)
    return comments + yaml.safe_dump({**config, "servers": servers}, sort_keys=False)


def _free_name(name: str, taken: Iterable[str]) -> str:
    """Return a server's name, as the configuration allows it, that is not taken."""
    plain = re.sub("[^A-Za-z0-9._-]", "-", name.removesuffix(".service")).strip("-._")[:60] or "llm"
    names = [plain, *(f"{plain}-{number}" for number in range(2, 100))]
    return next(one for one in names if one not in taken)


# -- doing
def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--dry-run", action="store_true", help="print the file, write and start nothing")
    add("--force", action="store_true", help="overwrite a configuration that is there")


def run(args: argparse.Namespace) -> int:
    """Raises ArbiterUnreachable and ConfigError."""
    site = SYSTEM if os.getuid() == 0 else site_of_user(os.environ)
    found = with_kept(looked(args.endpoint), site.settings / CONFIG)
    text = config_text(found, site.settings / KEYS)
    if args.dry_run:
        print(text, end="")
        return 0
    return install(site, text, args.endpoint, force=args.force)


def with_kept(found: Found, path: Path) -> Found:
    """Return what was found, with the address and the servers' bytes of a configuration that is
    there: clients know the address, and a server that is away or under its lease holds nothing
    itself. Raises ConfigError."""
    if not path.exists():
        return found
    before = load_gateway(path.read_text(encoding="utf-8"), str(path))
    sizes = {one.unit or one.container: one.vram or 0 for one in before.servers.values()}
    servers = [
        replace(one, held_bytes=one.held_bytes or sizes.get(one.name, 0)) for one in found.servers
    ]
    return replace(found, servers=servers, listen=before.listen)


def install(site: Site, text: str, endpoint: str | None, *, force: bool) -> int:
    """Write the files and start the service; print the address and what clients set. Return the
    exit code of systemctl. Raises ConfigError."""
    path, keys = site.settings / CONFIG, site.settings / KEYS
    try:
        listen = load_gateway(text, str(path)).listen
    except ConfigError as error:
        print(text, end="", file=sys.stderr)
        raise ConfigError(
            "no model server was found that can be configured",
            hint="start one as a unit or container and run setup again, or write the file by hand",
        ) from error
    if path.exists() and not force:
        raise ConfigError(
            f"{path} exists", hint="--force overwrites it; --dry-run shows the new one"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    _write(path, text)
    if not keys.exists():  # clients show those that are there
        key = {"name": "setup", "key": f"sk-{secrets.token_urlsafe(32)}"}
        _write(keys, yaml.safe_dump({"keys": [key]}))
    if endpoint and not (environ := site.settings / ENVIRON).exists():
        _write(environ, f"{ENDPOINT_VARIABLE}={endpoint}\n")
    token = load_keys(keys.read_text(encoding="utf-8"), str(keys)).keys[0].key.get_secret_value()
    print(f"written: {path}, {keys}\nhttp://{listen}")
    print(f"export OPENAI_BASE_URL=http://{listen}/v1\nexport OPENAI_API_KEY={token}", flush=True)
    return _start(site, path)


def _write(path: Path, text: str) -> None:
    """Write a new file of mode 0600."""
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(text)


def _start(site: Site, path: Path) -> int:
    """Start the service, whose unit is written where `vramctl install` has not."""
    control = ["systemctl", *(() if site.system else ("--user",))]
    if not said_by(*control, "show", "--property=Version"):
        print(f"systemd does not run here; start it by: vram-gateway serve --config {path}")
        return 0
    unit = site.units / UNIT
    if not unit.exists():
        unit.parent.mkdir(parents=True, exist_ok=True)
        unit.write_text(wanted(site, Path(sys.prefix))[unit])
    for words in (("daemon-reload",), ("enable", UNIT), ("restart", UNIT)):
        if code := subprocess.run([*control, *words], check=False).returncode:
            return code
    return 0
