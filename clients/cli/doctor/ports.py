"""Checks of clashes: several arbiters of one GPU, ports that another program has."""

import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from vram_arbiter.clients.cli.doctor.findings import CouldNotLook, Finding, ok, warning
from vram_arbiter.clients.cli.doctor.machine import Machine
from vram_arbiter.clients.cli.doctor.options import Options, flag, options_of

PROGRAM: Final = "vram-arbiter"
MODULE: Final = "vram_arbiter.arbiter"
LISTEN: Final = "0A"
PORT_VARIABLE: Final = "OTEL_EXPORTER_PROMETHEUS_PORT"


def arbiters(m: Machine) -> Iterator[Finding]:
    """At most one arbiter leases the real GPUs of this machine."""
    found = {pid: words for pid in m.pids() if _is_arbiter(words := m.command_line(pid))}
    real = {pid: words for pid, words in found.items() if not _simulates(words)}
    if len(real) > 1:
        named = ", ".join(f"pid {pid} ({' '.join(words[-3:])})" for pid, words in real.items())
        spare = next((pid for pid in sorted(real, reverse=True) if pid != m.arbiter.pid), 0)
        yield warning(
            "ports.arbiters",
            f"{len(real)} arbiters run without knowing each other: {named}",
            f"{m.sudo}kill {spare}",
        )
    else:
        yield ok("ports.arbiters", f"{len(found)} arbiter{'' if len(found) == 1 else 's'} seen")


def ports(m: Machine) -> Iterator[Finding]:
    """The daemon has the ports that it was told to serve."""
    options = options_of(m)
    wanted = _wanted(m, options)
    table = "".join(m.text(f"/proc/net/{name}") or "" for name in ("tcp", "tcp6"))
    if wanted and not table:
        raise CouldNotLook("/proc/net/tcp is not there")
    clean = True
    for port, key in wanted.items():
        owners = {
            int(words[7])
            for line in table.splitlines()
            if len(words := line.split()) > 9
            and words[3] == LISTEN
            and words[1].endswith(f":{port:04X}")
        }
        if foreign := owners - {m.arbiter.uid}:
            clean = False
            users = ", ".join(sorted(m.user_name(uid) for uid in foreign))
            yield warning(
                "ports.taken",
                f"port {port} ({key}) is taken by a program of {users}",
                _other_port(m, options, port, key),
            )
    if clean:
        said = ", ".join(f"{port} ({key})" for port, key in wanted.items()) or "none is configured"
        yield ok("ports.free", f"ports of the daemon: {said}")


def _wanted(m: Machine, options: Options) -> Mapping[int, str]:
    """Return the daemon's ports, with the key, flag or variable of each."""
    given = options.flag("--http")
    named = {
        PORT_VARIABLE: m.environ.get(PORT_VARIABLE, ""),
        "telemetry.prometheus_port": options.key("telemetry", "prometheus_port"),
        "--http" if given else "http.listen": given or options.key("http", "listen"),
    }
    found: dict[int, str] = {}
    for key, value in named.items():
        port = value.rpartition(":")[2]
        if port.isdecimal() and 0 < int(port) < 65536:
            found[int(port)] = key
    return found


def _other_port(m: Machine, options: Options, port: int, key: str) -> str:
    """Return the command that moves the daemon to the next port."""
    if key == PORT_VARIABLE:
        return f"export {key}={port + 1}"
    if key == "--http":
        return f"vram-arbiter --http {options.flag('--http').replace(str(port), str(port + 1))}"
    change = f"s/\\b{port}\\b/{port + 1}/"
    return f"{m.sudo}sed -i '{change}' {options.path} && {m.service('restart')}"


def _is_arbiter(words: Sequence[str]) -> bool:
    names = [os.path.basename(word) for word in words[:3]]
    if not names or not names[0].startswith("python"):
        return names[:1] == [PROGRAM]
    return names[1:2] == [PROGRAM] or names[1:] == ["-m", MODULE]


def _simulates(words: Sequence[str]) -> bool:
    return flag(words, "--gpu").startswith("fake:")
