"""Keep a tunnel: start ssh, see that a server greets behind every socket, start again after a loss.

ssh tells by a line that it listens, and by its end that the network is gone. A refusal (a host key,
the robot's key, a forwarding) would be the next attempt's too: it ends the keeper. Must not know
what is said on the sockets.
"""

import asyncio
import os
import re
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Final, Never

from vram_arbiter.clients.foreign.program import dying_with_parent
from vram_arbiter.clients.remote.ssh import FORWARDED, Tunnel
from vram_arbiter.schemas.errors import ConfigError, RemoteRefused
from vram_arbiter.schemas.runtime.printable import printable

RETRY_S: Final = 0.5
"""The first pause after a loss; the next is twice as long, until a tunnel is up again …"""
RETRY_MAX_S: Final = 10.0  # … and the longest
GREETING_S: Final = 5.0
"""How long a server may take to greet: it does so at once, before it is asked anything."""
CONNECT_S: Final = 30.0
"""For ssh to listen; it looks for signs of life only from then on."""
LAST_WORDS_S: Final = 1.0
WORDS_MAX: Final = 20  # lines of ssh that are looked at


REFUSALS: Final[Mapping[str, tuple[str, str]]] = {
    "host_key": (
        r"host key is known for|HAS CHANGED|Host key verification failed",
        "if the server's operator reads the same from `ssh-keygen -lf` of its host key, put the "
        "line that `ssh-keyscan` prints into {known_hosts}, in place of an old one",
    ),
    "key": (
        r"Permission denied \(|Too many authentication failures",
        "on the server: `vramctl remote authorize`, with this robot's public key and this user",
    ),
    "not_served": (  # sshd does not tell why: its log does
        r"is not served there",
        "on the server: is it started, in the folder of --server-runtime, and may this key and "
        "this user reach it? see sshd's log",
    ),
    "port": (
        r"Address already in use|cannot listen to port|Could not request local forwarding",
        "another program of this robot has the port",
    ),
}
"""What ssh, or the keeper, says of a refusal, and what to do about it, by `details.reason`."""
PASSING: Final = frozenset({"not_served"})
"""Of a server that was reached before: a machine that starts has its sshd before its sockets."""


def refusal(tunnel: Tunnel, words: Sequence[str], *, reached: bool) -> RemoteRefused | None:
    """Return the refusal that ssh's words tell of. `reached`: the tunnel was up before."""
    for reason, (said, hint) in REFUSALS.items():
        found = [line for line in words if re.search(said, line)]
        if found and not (reached and reason in PASSING):
            return RemoteRefused(
                f"{tunnel.host} refuses the tunnel: {found[0].strip('@ ')}",
                hint=hint.format(known_hosts=tunnel.known_hosts),
                details={"host": tunnel.host, "reason": reason, "ssh": list(words)},
            )
    return None


class Keeper:
    """`keep` runs until it is canceled, or the server refuses. `tell` gets lines for people, and
    whether the tunnel is up."""

    def __init__(self, tunnel: Tunnel, tell: Callable[[str, bool], None]) -> None:
        self._tunnel = tunnel
        self._tell = tell
        self._words: deque[str] = deque(maxlen=WORDS_MAX)
        self._is_up = False

    async def keep(self) -> Never:
        """Raises RemoteRefused, ConfigError."""
        pause_s, reached = RETRY_S, False
        while True:
            self._words.clear()
            if await self._one():
                pause_s, reached = RETRY_S, True
            elif error := refusal(self._tunnel, self._words, reached=reached):
                raise error
            why = self._words[-1] if self._words else "ssh ended"
            self._tell(f"no tunnel to {self._tunnel.host}: {why}; again in {pause_s:g} s", False)
            await asyncio.sleep(pause_s)
            pause_s = min(2 * pause_s, RETRY_MAX_S)

    async def _one(self) -> bool:
        """Run one ssh to its end, with its last lines in `_words`. Return whether the tunnel was
        up."""
        async with self._ssh() as ssh:
            if problem := await self._unready(ssh):
                self._words.append(problem)
                return False
            self._is_up = True
            self._tell(
                f"tunnel to {self._tunnel.host} is up: {', '.join(self._tunnel.names)}", True
            )
            await ssh.wait()
            self._is_up = False
            return True

    async def _unready(self, ssh: Process) -> str:
        """Return why the tunnel is not up, beside what ssh says of it; "": it is."""
        assert ssh.stdout is not None
        try:
            async with asyncio.timeout(CONNECT_S):
                said = await ssh.stdout.readline()
        except TimeoutError:
            return f"no connection within {CONNECT_S:g} s"
        if said.decode().strip() != FORWARDED:
            return "ssh ended"
        problems = [await _unserved(self._tunnel.socket(name)) for name in self._tunnel.names]
        return "; ".join(filter(None, problems))

    @asynccontextmanager
    async def _ssh(self) -> AsyncIterator[Process]:
        """A running ssh; at the end it has ended, and its sockets are removed."""
        try:
            ssh = await asyncio.create_subprocess_exec(
                *self._tunnel.command(),
                stdin=DEVNULL,
                stdout=PIPE,
                stderr=PIPE,
                # ssh starts its ProxyCommand by it; a service's user has one that starts nothing
                env={**os.environ, "SHELL": "/bin/sh"},
                preexec_fn=dying_with_parent(),
            )
        except FileNotFoundError as error:
            raise ConfigError("ssh is not installed", hint="apt install openssh-client") from error
        hearing = asyncio.create_task(self._hear(ssh))
        try:
            yield ssh
        finally:
            if ssh.returncode is None:
                ssh.terminate()
            await ssh.wait()
            await asyncio.wait([hearing], timeout=LAST_WORDS_S)
            hearing.cancel()
            for name in self._tunnel.names:
                self._tunnel.socket(name).unlink(missing_ok=True)

    async def _hear(self, ssh: Process) -> None:
        assert ssh.stderr is not None
        async for line in ssh.stderr:
            if text := printable(line.decode(errors="replace").strip()):
                self._words.append(text)
                if self._is_up:  # such as a channel that the server refuses
                    self._tell(f"{self._tunnel.host}: {text}", True)


async def _unserved(path: Path) -> str:
    """Return why no server greets behind a forwarded socket; "": one does."""
    try:
        async with asyncio.timeout(GREETING_S):
            reader, writer = await asyncio.open_unix_connection(path)
            try:
                greeted = await reader.read(1)
            finally:
                writer.close()
    except TimeoutError:
        return f"{path.stem} is silent"
    except OSError as error:
        return f"{path.stem}: {error.strerror}"
    return "" if greeted else f"{path.stem} is not served there"
