"""Units and containers, found by name and run: `systemctl`, `journalctl`, `docker` and `podman` are
small programs on PATH that do what the real ones are asked for here. The real ones run in
tests/packaging/test_units_start.py."""

import asyncio
import json
import os
import signal
import subprocess
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from vram_arbiter.clients.cli.main import run_main
from vram_arbiter.clients.foreign.service import Service, ServiceProgram, find_container, find_unit
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime import procfs

PATIENCE_S = 30.0
IDENTITY = "17eaa5034c6c"
SYSTEMCTL = """#!/bin/sh
echo "$@" >>calls
for name; do :; done
case "$*" in
*" show "*-.slice) echo ControlGroup=/ ;;
*" show "*) cat "$name.shown" 2>/dev/null; echo ControlGroup=$(cat "$name.runs" 2>/dev/null) ;;
*" start "*) echo /system.slice/$name >"$name.runs" ;;
*" stop "*) [ -e deaf ] || rm -f "$name.runs" ;;
*" kill "*) rm -f "$name.runs"; printf 'Result=signal\nExecMainStatus=9\n' >>"$name.shown" ;;
esac
"""
ENGINE = """#!/bin/sh
[ "$1" != info ] || exec echo cgroupfs
for name; do :; done
exec cat "$(basename "$0").$name"
"""


@pytest.fixture
def tools(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder in which the programs stand and work."""
    for name, text in (
        ("systemctl", SYSTEMCTL),
        ("journalctl", '#!/bin/sh\necho "$@" >>calls\n'),
        ("podman", ENGINE),
        ("docker", ENGINE),
    ):
        (tmp_path / name).write_text(text)
        (tmp_path / name).chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    return tmp_path


def unit(tools: Path, name: str = "llm.service", slice_: str = "system.slice") -> None:
    text = f"Id={name}\nLoadState=loaded\nSlice={slice_}\n"
    (tools / f"{name}.shown").write_text(text)


def add_container(tools: Path, engine: str, pid: int = 0, **host: str) -> None:
    told = [{"Id": IDENTITY, "State": {"Pid": pid}, "HostConfig": host}]
    (tools / f"{engine}.llm").write_text(json.dumps(told))


# -- by name
@pytest.mark.parametrize(
    ("slice_", "cgroup"),
    [
        ("system.slice", "/system.slice/llm.service"),
        ("gpu-big.slice", "/gpu.slice/gpu-big.slice/llm.service"),
        ("-.slice", "/llm.service"),
    ],
)
def test_the_cgroup_of_a_unit_that_does_not_run_is_known_by_its_slice(
    tools: Path, slice_: str, cgroup: str
) -> None:
    unit(tools, slice_=slice_)
    assert find_unit("llm.service").cgroup == cgroup
    (tools / "llm.service.runs").write_text("/elsewhere/llm.service\n")
    assert find_unit("llm.service").cgroup == "/elsewhere/llm.service", "one that runs, says"


@pytest.mark.parametrize(
    ("engine", "host", "cgroup"),
    [
        ("docker", {}, f"/docker/{IDENTITY}"),
        ("docker", {"CgroupParent": "/gpu"}, f"/gpu/{IDENTITY}"),
        ("podman", {"CgroupManager": "cgroupfs"}, f"/libpod_parent/libpod-{IDENTITY}"),
        (
            "podman",
            {"CgroupManager": "systemd", "CgroupParent": "gpu-big.slice"},
            f"/gpu.slice/gpu-big.slice/libpod-{IDENTITY}.scope",
        ),
        ("docker", {"CgroupManager": "systemd"}, f"/system.slice/docker-{IDENTITY}.scope"),
    ],
)
def test_the_cgroup_of_a_container_that_does_not_run_is_known_by_its_engine(
    tools: Path, engine: str, host: dict[str, str], cgroup: str
) -> None:
    add_container(tools, engine, **host)
    found = find_container("llm", 1.5)
    assert found.cgroup == cgroup
    assert found.stop == (engine, "stop", "-t2", "--", "llm")


def test_the_cgroup_of_a_container_that_runs_is_its_process_s(tools: Path) -> None:
    """Down to the folder with its id: what its own init makes below is not its name."""
    root = procfs.cgroup_root()
    if root is None:
        pytest.skip("no cgroup v2 hierarchy is mounted")
    own = root / procfs.read_cgroup(os.getpid())[1:] / f"x-{IDENTITY}{os.getpid()}.scope"
    try:
        own.joinpath("init").mkdir(parents=True)
    except OSError as error:
        pytest.skip(f"no cgroup can be made: {error}")
    into = f'echo $$ >"{own}/init/cgroup.procs" && echo && exec cat'
    try:
        with subprocess.Popen(["sh", "-c", into], stdin=-1, stdout=-1) as inside:
            inside.stdout.readline()
            told = [{"Id": IDENTITY, "State": {"Pid": inside.pid}}]
            (tools / "podman.llm").write_text(json.dumps(told))
            assert find_container("llm", None).cgroup == f"/{own.relative_to(root)}"
            inside.communicate(b"")
    finally:
        own.joinpath("init").rmdir()
        own.rmdir()


@pytest.mark.skipif(not procfs.read_cgroup(os.getpid()), reason="no cgroup v2 hierarchy")
def test_a_container_without_a_cgroup_of_its_own_gets_no_lease(tools: Path) -> None:
    """Regression: rootless podman without systemd makes none, and the container ran on beside its
    lease, as a stowaway. One that runs is refused, one that was started there is ended."""
    add_container(tools, "podman", CgroupManager="cgroupfs")
    found = find_container("llm", None)
    add_container(tools, "podman", os.getpid(), CgroupManager="cgroupfs")
    assert found.look()[0] == procfs.read_cgroup(os.getpid())
    with pytest.raises(ConfigError, match="'llm' has no cgroup of its own"):
        find_container("llm", None)


@pytest.mark.parametrize("name", ["", "-x", "a b", "a/b", "a\n", "x" * 256])
def test_what_is_no_name_is_given_to_no_program(tools: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="not a name"):
        find_unit(name)
    with pytest.raises(ConfigError, match="not a name"):
        find_container(name, None)
    assert not (tools / "calls").exists()


def test_what_is_not_there_is_said(tools: Path) -> None:
    (tools / "llm.socket.shown").write_text("Id=llm.socket\nLoadState=loaded\nSlice=a.slice\n")
    for name in ("llm.service", "llm.socket"):
        with pytest.raises(ConfigError, match="no service 'llm"):
            find_unit(name)
    with pytest.raises(ConfigError, match="neither podman nor docker knows a container 'llm'"):
        find_container("llm", None)


@pytest.mark.parametrize(
    "words", [["--unit", "a", "--", "b"], ["--unit", "a", "--container", "b"], []]
)
def test_one_thing_is_run_and_no_other(
    tools: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        run_main(["run", "--vram", "1GiB", *words])
    assert ended.value.code == 2
    assert "or --unit NAME, or --container NAME" in capsys.readouterr().err


def test_a_unit_that_is_not_there_is_wrong_use(
    tools: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_main(["run", "--vram", "1GiB", "--unit", "llm"]) == 2
    assert "there is no service 'llm'" in capsys.readouterr().err


# -- running
def run_unit(
    tools: Path, test: Callable[[ServiceProgram], Awaitable[None]], cgroup: str | None = None
) -> None:
    """Run a unit, in the cgroup that its lease names unless another is given."""
    unit(tools)
    found = find_unit("llm.service")
    placed = found if cgroup is None else Service(
        found.name, cgroup, found.run, found.stop, found.kill, found.log, found.look
    )  # fmt: skip

    async def run() -> None:
        async with asyncio.timeout(PATIENCE_S):
            program = ServiceProgram(placed)
            while not await asyncio.to_thread((tools / f"{placed.name}.runs").exists):
                await asyncio.sleep(0.02)
            await test(program)
            assert not program.running

    asyncio.run(run())


def calls(tools: Path) -> list[str]:
    """Commands that did something."""
    lines = (tools / "calls").read_text().splitlines()
    return [line.removeprefix("--no-ask-password ") for line in lines if " show " not in line]


START = "start -- llm.service"
STOP = "stop -- llm.service"


def test_one_that_ends_itself_gives_its_result_and_its_last_lines(tools: Path) -> None:
    async def test(program: ServiceProgram) -> None:
        with (tools / "llm.service.shown").open("a") as shown:
            shown.write("Result=exit-code\nExecMainStatus=7\n")
        (tools / "llm.service.runs").unlink()
        assert await program.wait() == 7
        assert await program.end(1.0) is False

    run_unit(tools, test)
    log = "--unit=llm.service --lines=20 --output=cat --quiet"
    assert calls(tools) == [START, STOP, log], "its manager does not start it again by itself"


@pytest.mark.parametrize("by", ["end", signal.SIGTERM, signal.SIGINT])
def test_it_is_stopped_in_order(tools: Path, by: str | signal.Signals) -> None:
    async def test(program: ServiceProgram) -> None:
        if isinstance(by, str):
            assert await program.end(None) is False
        else:
            program.send_signal(signal.SIGUSR1)  # its manager's matter
            program.send_signal(by)
        assert await program.wait() == 0

    run_unit(tools, test)
    assert set(calls(tools)) == {START, STOP}


def test_one_that_does_not_stop_in_time_is_killed(tools: Path) -> None:
    (tools / "deaf").touch()

    async def test(program: ServiceProgram) -> None:
        assert await program.end(0.05) is True
        assert await program.wait() == 9

    run_unit(tools, test)
    assert calls(tools)[:3] == [START, STOP, "kill --signal=SIGKILL -- llm.service"]


def test_one_outside_the_cgroup_of_its_lease_is_ended(
    tools: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Nothing would charge its bytes to the lease."""

    async def test(program: ServiceProgram) -> None:
        assert await program.wait() == 1

    run_unit(tools, test, cgroup="/system.slice/llm")
    assert set(calls(tools)) == {START, STOP}
    assert "runs in the cgroup /system.slice/llm.service, not in" in capfd.readouterr().err
