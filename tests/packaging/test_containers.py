"""The images and the compose file, as far as they go without a container engine and a registry.

The entry point runs as PID 1 with the restrictions of compose.yaml; that an image can be built from
what its COPY lines name is shown in test_wheel.py. A build by a real builder is described in
docs/how-to/containers.md.
"""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

import pytest
import yaml

from tests.packaging.installed import DEPENDENCIES, PYTHON, install_into
from tests.packaging.machine import TOOLS, obstacle
from tests.support.paths import ROOT
from tests.support.waiting import PATIENCE_S, until
from vram_arbiter.clients.cli.doctor.health import UNIT_SCORE
from vram_arbiter.schemas.runtime.trust import SERVICE_USERS

FOLDER = ROOT / "configs" / "containers"
IMAGES = {"arbiter": "Containerfile", "reward": "Containerfile.sidecar"}
OBSTACLE = obstacle()


@dataclass
class Containerfile:
    """The instructions of one file, those of its stages one after another."""

    copies: list[str] = field(default_factory=list)
    runs: list[str] = field(default_factory=list)
    environ: dict[str, str] = field(default_factory=dict)
    user: str = ""
    entrypoint: list[str] = field(default_factory=list)


def text_of(name: str) -> Containerfile:
    text = (FOLDER / name).read_text(encoding="utf-8")
    text = re.sub(r"^#.*\n", "", text, flags=re.MULTILINE).replace("\\\n", " ")
    found = Containerfile()
    for line in filter(None, text.splitlines()):
        instruction, _, rest = line.partition(" ")
        words = rest.split()
        match instruction:
            case "COPY" if not rest.startswith("--from="):
                found.copies += words[:-1]
            case "RUN":
                found.runs.append(rest)
            case "ENV":
                found.environ |= dict(word.split("=", 1) for word in words)
            case "USER":
                found.user = words[0]
            case "ENTRYPOINT":
                found.entrypoint = json.loads(rest)
    return found


def compose() -> dict[str, Any]:
    return cast("dict[str, Any]", yaml.safe_load((FOLDER / "compose.yaml").read_text()))


# -- the files
@pytest.mark.parametrize("name", IMAGES.values())
def test_the_linter_is_silent(name: str) -> None:
    linter = Path(sys.executable).with_name("hadolint")
    if not linter.exists():
        pytest.skip("hadolint is not installed: no wheel for this machine")
    done = subprocess.run([linter, str(FOLDER / name)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_the_compose_file_follows_its_specification() -> None:
    """The schema of compose-spec, as check-jsonschema brings it."""
    jsonschema = pytest.importorskip("jsonschema", reason="the dependency group `dev`")
    found = find_spec("check_jsonschema")  # not imported: that takes seconds
    assert found.origin is not None
    vendored = Path(found.origin).parent / "builtin_schemas/vendor/compose-spec.json"
    schema = json.loads(vendored.read_text(encoding="utf-8"))
    jsonschema.validate(compose(), schema)
    wrong = compose()
    wrong["services"]["arbiter"]["read_onyl"] = True
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(wrong, schema)


@pytest.mark.parametrize("service", IMAGES)
def test_a_service_is_restricted_and_reaches_gpu_and_socket(service: str) -> None:
    found, image = compose()["services"][service], text_of(IMAGES[service])
    assert (ROOT / found["build"]["dockerfile"]).samefile(FOLDER / IMAGES[service])
    assert (FOLDER / found["build"]["context"]).samefile(ROOT)
    assert found["read_only"] is True
    assert found["cap_drop"] == ["ALL"]
    assert found["restart"] == "unless-stopped"
    assert f"sockets:{image.environ['VRAM_ARBITER_RUNTIME']}" in found["volumes"]
    (devices,) = found["deploy"]["resources"]["reservations"]["devices"]
    assert devices["driver"] == "nvidia"
    wanted = set(image.environ["NVIDIA_DRIVER_CAPABILITIES"].split(","))
    assert set(devices["capabilities"]) == {"gpu", *wanted}
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    program = Path(image.entrypoint[0])
    assert program.parent == Path("/opt/vram-arbiter/bin")
    assert program.name in scripts
    assert "root" not in image.user
    assert not image.user.startswith("0")


def test_the_arbiter_sees_every_process_and_a_sidecar_does_not_end_with_it() -> None:
    services = compose()["services"]
    assert services["arbiter"]["pid"] == "host"
    assert services["arbiter"]["network_mode"] == "none"
    assert "state:/var/lib/vram-arbiter" in services["arbiter"]["volumes"]
    assert "depends_on" not in services["reward"]
    assert services["arbiter"]["oom_score_adj"] == UNIT_SCORE, "doctor warned in every container"


def test_the_users_have_the_same_ids_and_names_in_both_images() -> None:
    """A client believes a server by the name of its user, which is looked up in its own image."""
    users = [re.findall(r"useradd --uid (\d+) --gid (\d+) .*? (vram-\w+)",
                        " ".join(text_of(name).runs)) for name in IMAGES.values()]  # fmt: skip
    assert users[0] == users[1]
    ids = {name: f"{uid}:{gid}" for uid, gid, name in users[0]}
    assert text_of("Containerfile").user == ids[SERVICE_USERS["arbiter"]]
    assert text_of("Containerfile.sidecar").user == ids[SERVICE_USERS["sidecar"]]


# -- the arbiter as PID 1
@dataclass(frozen=True)
class Container:
    """A running container: `pid` is that of its PID 1 outside."""

    process: subprocess.Popen[str]
    pid: int
    user: str
    environ: dict[str, str]

    def exec(self, *command: str) -> list[str]:
        """The command line that runs a command in it, as `docker exec` does."""
        environ = [f"{name}={value}" for name, value in self.environ.items()]
        become = ["setpriv", f"--reuid={self.user}", f"--regid={self.user}", "--clear-groups"]
        return [
            "nsenter", f"--target={self.pid}", "--pid", "--mount", "--net", "--ipc",
            *become, "env", "-i", *environ, *command,
        ]  # fmt: skip

    def run(self, *command: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            self.exec(*command), capture_output=True, text=True, timeout=PATIENCE_S, check=False
        )


@contextlib.contextmanager
def container(folder: Path) -> Iterator[Container]:
    """The arbiter's image with a simulated GPU."""
    image, service = text_of("Containerfile"), compose()["services"]["arbiter"]
    install_into(
        folder / "prefix",
        seen_at=Path("/opt/vram-arbiter"),
        python=Path("/opt/python") / PYTHON.relative_to(sys.base_prefix),
        dependencies=Path("/opt/site-packages"),
    )
    user = image.user.partition(":")[0]
    environ = {**image.environ, "LD_LIBRARY_PATH": "/opt/python/lib"}
    writable = [volume.split(":")[1] for volume in service["volumes"] if ":ro" not in volume]
    # the group that the socket goes to is of the image; here the user has none of that name
    entry = [word for word in image.entrypoint if word not in ("--group", "vram-arbiter")]
    process = subprocess.Popen(
        [
            "unshare", "--fork", "--kill-child", "--pid", "--mount", "--net", "--ipc",
            str(Path(__file__).with_name("container.sh")),
            str(folder / "prefix"), sys.base_prefix, str(DEPENDENCIES), user, *writable, "--",
            "env", "-i", *(f"{name}={value}" for name, value in environ.items()),
            *entry, "--gpu", "fake:8GiB",
        ],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
    pid = process.pid
    try:
        pid = int(until(lambda: children.read_text().split())[0])
        yield Container(process, pid, user, environ)
    finally:
        if process.poll() is None:  # a change of user undid what --kill-child would do
            os.kill(pid, signal.SIGKILL)
        process.communicate()


@pytest.mark.e2e
@pytest.mark.skipif(OBSTACLE is not None, reason=f"no namespaces here: {OBSTACLE} {TOOLS}")
def test_the_arbiter_is_pid_1_of_a_read_only_container(tmp_path: Path) -> None:
    """It serves a holder in a PID namespace below its own, as a sidecar's container is, notices the
    holder's end, and ends by SIGTERM, which the kernel withholds from a PID 1 without a handler."""
    os.chmod(tmp_path, 0o755)
    with container(tmp_path) as made:
        until(Path(f"/proc/{made.pid}/root/run/vram-arbiter/arbiter.sock").exists)
        health = compose()["services"]["arbiter"]["healthcheck"]["test"][1:]
        assert made.run(*health).returncode == 0
        assert "Read-only file system" in made.run("touch", "/var/lib/a", "/tmp/a").stderr
        status = Path(f"/proc/{made.pid}/status").read_text()
        assert re.search(r"^NSpid:.*\t1$", status, re.MULTILINE)
        assert re.search(r"^CapBnd:\t0+$", status, re.MULTILINE)

        program = made.exec("vramctl", "run", "--vram", "1GiB", "--name", "below", "--")
        below = ["nsenter", f"--target={made.pid}", "--pid", "--mount", "--net", "--ipc",
                 "unshare", "--fork", "--kill-child", "--pid"]  # fmt: skip
        inner = program[program.index("setpriv") :]
        holder = subprocess.Popen([*below, *inner, "sleep", "1000"])

        def leases() -> list[dict[str, Any]]:
            status = json.loads(made.run("vramctl", "status", "--json").stdout)
            return cast("list[dict[str, Any]]", status["leases"])

        (lease,) = until(lambda: [found for found in leases() if found["state"] == "held"] or None)
        seen = made.run("readlink", f"/proc/{lease['pid']}/ns/pid").stdout
        assert seen not in ("", made.run("readlink", "/proc/self/ns/pid").stdout)
        made.run("sh", "-c", f"kill -KILL {lease['pid']}")
        holder.wait(PATIENCE_S)
        until(lambda: leases() == [] or None)

        os.kill(made.pid, signal.SIGTERM)
        said, _ = made.process.communicate(timeout=PATIENCE_S)
        assert made.process.returncode == 0, said
        assert "stopped" in said
