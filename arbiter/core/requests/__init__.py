"""What clients, operators and the machine ask of leases. Each function checks first, then changes.

- `requests`: acquire, reacquire, cancel, ready, renew, revoke_ack, unloading, release, oom.
- `uses`: begin and end of a use.
- `sessions`: connections, deaths, expiry, a journal that fails.
- `operators`: evict, kill, pin, drain, release_dead.
- `recovery`: journal records and reattaching holders after a restart; resume from suspend.
"""
