"""The eviction ladder: revoke, revoke again until acknowledged, remind, deadline, overstay.

Public (`eviction`): `ask` revokes a holder; `acknowledge`, `reached_safe_point`, `ask_again` follow
it; `deny` ends a wait with an error; `on_ladder_due` and `on_overstay_due` serve its timers.
"""
