"""Ports for programs that listen later."""

import socket
from pathlib import Path

import pytest

from vram_arbiter.schemas.runtime import ports


def test_no_outgoing_connection_can_take_it_before_its_program_listens() -> None:
    """A port of the kernel's range was taken within the seconds of a start: the page had none."""
    first = int(ports.EPHEMERAL.read_text().split()[0])
    assert all(ports.FIRST <= ports.free_port() < first for _ in range(20))


def test_one_that_is_taken_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", port := ports.free_port())):
        kernels = tmp_path / "range"
        kernels.write_text(f"{port + 1}\t60999\n")
        monkeypatch.setattr(ports, "FIRST", port)
        monkeypatch.setattr(ports, "EPHEMERAL", kernels)
        with pytest.raises(OSError, match="is free"):
            ports.free_port()
    assert ports.free_port() == port
