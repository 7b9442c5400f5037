"""Keep a tunnel: start ssh, see that a server greets behind every socket, start again after a loss.

ssh tells by a line that it listens, and by its end that the network is gone. A refusal (a host key,
the robot's key, a forwarding) would be the next attempt's too: it ends the keeping. Must not know
what is said on the sockets.
"""

import asyncio
import contextlib
import os
import re
from asyncio.subprocess import DEVNULL, PIPE, Process
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
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
WORDS_MAX: Final = 20  # lines of ssh that are looked at
type Tell = Callable[[str, bool], None]
"""Gets lines for people, and whether the tunnel is up."""

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


async def keep(tunnel: Tunnel, tell: Tell) -> Never:
    """Keep a tunnel until this is canceled. Raises RemoteRefused, ConfigError."""
    pause_s, reached = RETRY_S, False
    while True:
        words: deque[str] = deque(maxlen=WORDS_MAX)
        if await _once(tunnel, tell, words):
            pause_s, reached = RETRY_S, True
        elif error := refusal(tunnel, words, reached=reached):
            raise error
        why = words[-1] if words else "ssh ended"
        tell(f"no tunnel to {tunnel.host}: {why}; again in {pause_s:g} s", False)
        await asyncio.sleep(pause_s)
        pause_s = min(2 * pause_s, RETRY_MAX_S)


async def _once(tunnel: Tunnel, tell: Tell, words: deque[str]) -> bool:
    """Run one ssh to its end, and add its last lines to `words`, at the end why the tunnel did not
    come up. Return whether it was up."""
    up, problem = False, ""
    try:
        async with _started(tunnel) as ssh, asyncio.timeout(CONNECT_S) as connecting:
            async for line in _lines(ssh):
                if line == FORWARDED:
                    connecting.reschedule(None)
                    if problem := await _unserved(tunnel):
                        ssh.terminate()
                    else:
                        up = True
                        tell(f"tunnel to {tunnel.host} is up: {', '.join(tunnel.names)}", up)
                else:
                    words.append(line)
                    if up:  # such as a channel that the server refuses
                        tell(f"{tunnel.host}: {line}", up)
    except TimeoutError:
        problem = f"no connection within {CONNECT_S:g} s"
    if problem:
        words.append(problem)
    return up


@contextlib.asynccontextmanager
async def _started(tunnel: Tunnel) -> AsyncIterator[Process]:
    """A running ssh; at the end it has ended, and its sockets are removed. Raises ConfigError."""
    try:
        ssh = await asyncio.create_subprocess_exec(
            *tunnel.command(),
            stdin=DEVNULL,
            stdout=DEVNULL,
            stderr=PIPE,
            # ssh starts its ProxyCommand by it; a service's user has one that starts nothing
            env={**os.environ, "SHELL": "/bin/sh"},
            preexec_fn=dying_with_parent(),
        )
    except FileNotFoundError as error:
        raise ConfigError("ssh is not installed", hint="apt install openssh-client") from error
    try:
        yield ssh
    finally:
        if ssh.returncode is None:
            ssh.terminate()
        await ssh.wait()
        for name in tunnel.names:
            tunnel.socket(name).unlink(missing_ok=True)


async def _lines(ssh: Process) -> AsyncIterator[str]:
    """Yield what ssh says, and dial, until both have ended."""
    assert ssh.stderr is not None
    async for line in ssh.stderr:
        if text := printable(line.decode(errors="replace").strip()):
            yield text


async def _unserved(tunnel: Tunnel) -> str:
    """Return behind which of the forwarded sockets no server greets, and why; "": one does behind
    each."""
    found = [await _ungreeted(tunnel.socket(name)) for name in tunnel.names]
    return "; ".join(filter(None, found))


async def _ungreeted(path: Path) -> str:
    try:
        async with asyncio.timeout(GREETING_S):
            reader, writer = await asyncio.open_unix_connection(path)
            with contextlib.closing(writer):
                greeted = await reader.read(1)
    except TimeoutError:
        return f"{path.stem} is silent"
    except OSError as error:
        return f"{path.stem}: {error.strerror}"
    return "" if greeted else f"{path.stem} is not served there"
