"""Six STS3215 servos on the other end of a pseudo-terminal: the bytes of Feetech's protocol, and
registers that behave.

A servo goes where it is told while its torque is on. `cut` pulls the cable.
"""

import os
import pty
import select
import struct
import threading
import tty

PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 1, 2, 3, 0x82, 0x83
MODEL_NUMBER, TORQUE, GOAL, PRESENT = 3, 40, 42, 56
MIN_LIMIT, MAX_LIMIT = 9, 11
STS3215 = 777


class ServoBus:
    """`path` is the serial port. Use with `with`."""

    def __init__(self, ids: range = range(1, 7), centre: int = 2047) -> None:
        self.registers = {servo: bytearray(128) for servo in ids}
        for servo in ids:
            self.put(servo, MODEL_NUMBER, STS3215)
            self.put(servo, MIN_LIMIT, 0)
            self.put(servo, MAX_LIMIT, 4095)
            self.put(servo, PRESENT, centre)
        self._master, self._slave = pty.openpty()
        tty.setraw(self._master)
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._wake_out, self._wake_in = os.pipe()
        self._silent = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self) -> "ServoBus":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        os.write(self._wake_in, b"x")
        self._thread.join(timeout=10)
        for end in (self._master, self._slave, self._wake_in, self._wake_out):
            os.close(end)

    def put(self, servo: int, address: int, value: int) -> None:
        struct.pack_into("<H", self.registers[servo], address, value)

    def get(self, servo: int, address: int) -> int:
        value: int = struct.unpack_from("<H", self.registers[servo], address)[0]
        return value

    def torque(self, servo: int) -> bool:
        return bool(self.registers[servo][TORQUE])

    @property
    def silent(self) -> bool:
        return self._silent.is_set()

    def cut(self) -> None:
        """From now on nobody answers."""
        self._silent.set()

    def mend(self) -> None:
        """Plug the cable in again."""
        self._silent.clear()

    # -- the wire
    def _serve(self) -> None:
        heard = b""
        while True:
            ready, _, _ = select.select([self._master, self._wake_out], [], [])
            if self._wake_out in ready:
                return
            heard += os.read(self._master, 4096)
            while (packet := _packet(heard)) is not None:
                servo, instruction, params, heard = packet
                if not self._silent.is_set():
                    self._obey(servo, instruction, params)

    def _obey(self, servo: int, instruction: int, params: bytes) -> None:
        if instruction == SYNC_READ:
            for each in params[2:]:
                self._reply(each, bytes(self.registers[each][params[0] : params[0] + params[1]]))
        elif instruction == SYNC_WRITE:
            width = params[1] + 1
            for start in range(2, len(params), width):
                self._write(params[start], params[0], params[start + 1 : start + width])
        elif servo in self.registers:
            data = b""
            if instruction == READ:
                data = bytes(self.registers[servo][params[0] : params[0] + params[1]])
            elif instruction == WRITE:
                self._write(servo, params[0], params[1:])
            self._reply(servo, data)

    def _write(self, servo: int, address: int, data: bytes) -> None:
        self.registers[servo][address : address + len(data)] = data
        if address == GOAL and self.torque(servo):
            self.put(servo, PRESENT, self.get(servo, GOAL))

    def _reply(self, servo: int, data: bytes) -> None:
        body = bytes([servo, len(data) + 2, 0]) + data
        os.write(self._master, b"\xff\xff" + body + bytes([~sum(body) & 0xFF]))


def _packet(heard: bytes) -> tuple[int, int, bytes, bytes] | None:
    """Servo, instruction, parameters and what is left, once a whole packet is there."""
    start = heard.find(b"\xff\xff")
    if start < 0 or len(heard) < start + 4:
        return None
    length = heard[start + 3]
    end = start + 4 + length
    if len(heard) < end:
        return None
    return heard[start + 2], heard[start + 4], heard[start + 5 : end - 1], heard[end:]
