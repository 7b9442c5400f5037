"""The arbiter's wire: one msgpack map per message over ZeroMQ.

Request   {"op": …, "id": n, …fields, "traceparent"?}                             client → arbiter
Reply     {"re": n, "epoch": e, "ok": true, …}                                    arbiter → client
          {"re": n, "epoch": e, "ok": false, "error": {"code", "message", "hint", "details"}}
Push      {"push": kind, "seq": n, "epoch": e, …}, kinds in `pushes`              arbiter → client

`requests` holds what the arbiter validates. Everything that it sends
is a frozen dataclass of the other modules, encoded and decoded by `schemas.codec`. Those modules
use the standard library only, so the sans-IO core and the clients' fast path can import them.

Compatibility: new fields have defaults, a type never changes, and a client ignores fields that it
does not know.
"""
