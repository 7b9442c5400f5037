"""Doors as flags ask for them: what is refused before anything is served."""

import socket
from pathlib import Path

import pytest

from tests.support.ports import free_port
from tests.support.waiting import play
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.manifest import load_manifest
from vram_arbiter.sidecars.__main__ import main
from vram_arbiter.sidecars.doors.open import Door, door_of, opened

pytestmark = pytest.mark.heavy
SKILLS = Path(__file__).parents[3] / "configs/rskills"
GRAB, DETECTOR = (
    load_manifest(SKILLS / f"so101-{name}/rskill.yaml") for name in ("grab", "detector")
)


@pytest.mark.parametrize(
    "listen", [None, "", "8080", "0.0.0.0:8080", "[::1]:8080", "127.0.0.1:0", "127.0.0.1:65536"]
)
def test_a_door_listens_on_loopback_alone(listen: str | None) -> None:
    with pytest.raises(ConfigError, match=r"needs --listen 127.0.0.1:PORT, not .*ssh -L"):
        door_of("lerobot", listen, (), None)


def test_flags_of_another_protocol_are_refused(tmp_path: Path) -> None:
    keys = tmp_path / "keys"
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        door_of("openpi", "localhost:8080", (), keys)
    keys.write_text("\n \n")
    with pytest.raises(ConfigError, match="has no key"):
        door_of("openpi", "localhost:8080", (), keys)
    keys.write_text("one\n\n two \n")
    assert door_of("openpi", "localhost:8080", (), keys) == Door(
        "openpi", 8080, keys=(b"one", b"two")
    )
    with pytest.raises(ConfigError, match="lerobot has no API keys"):
        door_of("lerobot", "localhost:8080", (), keys)
    with pytest.raises(ConfigError, match="openpi has no choice of policies"):
        door_of("openpi", "localhost:8080", ("ipc:///x",), None)
    with pytest.raises(ConfigError, match=r"so101-detector is a detector, --door openpi serves"):
        Door("openpi", 8080).check(DETECTOR)


def test_the_check_looks_at_the_door(capsys: pytest.CaptureFixture[str]) -> None:
    flags = ["--name", "x", "--device", "none", "--footprint", "1GB"]
    door = ["--door", "lerobot", "--listen", "127.0.0.1:8080"]
    assert main([*flags, "--rskill", "so101-detector", *door, "--check"]) == 2
    assert "BAD  door" in capsys.readouterr().out
    for wrong in (["--door", "lerobot"], ["--listen", "127.0.0.1:8080"], ["--offer", "grab"]):
        for more in ([], ["--check"]):
            assert main([*flags, "--rskill", "so101-grab", *wrong, *more]) == 2


@pytest.mark.parametrize("protocol", ["lerobot", "openpi"])
def test_a_door_opens_where_a_killed_process_left_its_socket(
    protocol: str, short_folder: Path
) -> None:
    endpoint, left = f"ipc://{short_folder}/s.sock", short_folder / f"s.{protocol}"
    left.touch()

    async def story() -> None:
        door = Door(protocol, free_port())  # type: ignore[arg-type]
        async with opened(door, GRAB, endpoint, 60.0):
            assert left.is_socket()
            assert left.stat().st_mode & 0o777 == 0o660
            socket.create_connection(("127.0.0.1", door.port)).close()
            with pytest.raises(ConfigError, match=f"port {door.port} of 127.0.0.1"):
                await opened(door, GRAB, f"ipc://{short_folder}/t.sock", 60.0).__aenter__()
        assert not left.exists()

    play(story)
