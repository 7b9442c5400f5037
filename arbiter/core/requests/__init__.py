"""What clients, operators and the machine ask of leases. Each function checks first, then changes.

- `requests`: acquire, cancel, ready, renew, revoke_ack, unloading, release, oom; limits.
- `uses`: begin, yield and end of a use.
- `sessions`: connections, deaths, expiry, a journal that fails.
- `operators`: evict, pin, drain, release_dead.
- `recovery`: journal records and reattaching holders after a restart; resume from suspend.
"""
