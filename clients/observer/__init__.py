"""`vram-observer`: everything that people and machines look at, made beside the daemon.

A client of the daemon's socket with the role observer: status page and metrics over HTTP, spans,
metrics and log records over OTLP, hooks. `program` joins the parts. Needs the extra `observer`.
Whatever happens to it touches no grant.
"""
