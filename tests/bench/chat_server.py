"""`python -m tests.bench.chat_server PORT`: a bare model server without a GPU, so that little but
the gateway is measured. `POST …`: `max_tokens` words as server-sent events, at once or one each
`token_s`; `GET /bytes/COUNT`: a download.

`python -m tests.bench.chat_server PORT TO`: a relay of TCP to port TO, which is what any process
between a client and its server costs.
"""

import asyncio
import json
import sys
from collections.abc import Iterator
from functools import partial
from typing import Final

WORD: Final = b'{"object": "chat.completion.chunk", "choices": [{"delta": {"content": " word"}}]}'
EVENT: Final = b"%x\r\ndata: %b\n\n\r\n" % (len(WORD) + 8, WORD)
END: Final = b"e\r\ndata: [DONE]\n\n\r\n0\r\n\r\n"
STREAM: Final = (
    b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\nTransfer-Encoding: chunked\r\n\r\n"
)
PIECE: Final = bytes(1 << 18)


async def answer_chats(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    try:
        while head := await reader.readuntil(b"\r\n\r\n"):
            method, path, _ = head.split(b" ", 2)
            if method == b"POST":
                size = head.lower().partition(b"content-length:")[2].partition(b"\r\n")[0]
                body = json.loads(await reader.readexactly(int(size)))
                await _say(writer, body["max_tokens"], body.get("token_s", 0.0))
            else:
                count = int(path.rpartition(b"/bytes/")[2] or 0) if b"/bytes/" in path else 0
                writer.write(b"HTTP/1.1 200 OK\r\nContent-Length: %d\r\n\r\n" % count)
                for piece in _pieces(count):
                    writer.write(piece)
                    await writer.drain()
    except (asyncio.IncompleteReadError, ConnectionError):
        pass
    finally:
        writer.close()


async def _say(writer: asyncio.StreamWriter, words: int, token_s: float) -> None:
    """The first word comes with the head, as from a server that streams."""
    if not token_s:
        writer.write(STREAM + EVENT)
        for _ in range(words - 1):
            writer.write(EVENT)
            await writer.drain()
    else:
        writer.write(STREAM)
        due = asyncio.get_running_loop().time()
        for _ in range(words):
            due += token_s
            await asyncio.sleep(due - asyncio.get_running_loop().time())
            writer.write(EVENT)
    writer.write(END)


def _pieces(count: int) -> Iterator[bytes]:
    while count > 0:
        yield PIECE[:count]
        count -= len(PIECE)


async def relay(to: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    there, here = await asyncio.open_connection("127.0.0.1", to)
    await asyncio.gather(_pass_on(reader, here), _pass_on(there, writer))


async def _pass_on(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
    try:
        while data := await source.read(1 << 18):
            sink.write(data)
            await sink.drain()
    except ConnectionError:
        pass
    finally:
        sink.close()


async def main(port: int, to: int) -> None:
    server = await asyncio.start_server(
        partial(relay, to) if to else answer_chats, "127.0.0.1", port
    )
    await server.serve_forever()


if __name__ == "__main__":
    asyncio.run(main(*map(int, (*sys.argv[1:], "0")[:2])))
