"""What clients, operators and the machine ask of leases. Each function checks first, then changes.

- `requests`: acquire, cancel, ready, renew, revoke_ack, unloading, release, oom.
- `uses`: begin, yield and end of a use. `sessions`: connections, deaths, a journal that fails.
- `expiry`: leases that end without their holder. `operators`: evict, pin, drain, release_dead.
- `recovery`: journal records and reattaching holders after a restart. `resume`: after a suspend.
- `limits`: shares of limited places. `refusals`: notes of refused requests.
"""
