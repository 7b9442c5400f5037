"""`vram-gateway`: model servers behind one address, each awake when a request needs it.

`vram-gateway serve --config FILE` prints `http://ADDRESS:PORT` as its first line on stdout once it
listens, and runs until SIGTERM. Its parts:

- `routing`: body → model's name → server; pure.
- `turns`: which waiting request is next; pure.
- `keys`: who asks, and for what it may; pure.
- `program`: one model server under one lease, by a child `vramctl run --control`.
- `logs`: what servers print, and its readers.
- `server`: the states of one server, and the requests that wait for it.
- `upstream`: connections to servers, and where their answers end; `reply`: what a client gets, with
  the errors; `proxy`: bytes both ways, HTTP and WebSocket.
- `front`: llama-swap's endpoints, and limits.
- `gateway`: all of it joined; `__main__`: the command line.
- `imports`: llama-swap's configuration → the gateway's; pure, but for its command.
- `setup`: what runs on this machine → the gateway's configuration and unit.
- `demo`, `stand_in`: simulated users of two stand-in servers.

It must not import the daemon: a lease is `vramctl run`'s, which requests in flight use by its
token.
"""
