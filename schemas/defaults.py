"""Every default of the product, each a named constant. Pure constants; the core may import this."""

KIB = 1024
MIB = 1024 * KIB
GIB = 1024 * MIB

WIRE_VERSION = 3  # 3: no gangs, no resizing, no `yield`; a person's `kill`

# Leases
LEASE_TTL_S = 10.0
RENEW_FRACTION = 1 / 3  # clients renew every ttl/3
FENCE_GRACE_S = 5.0  # after ttl + grace without the arbiter a client unloads by itself
MIN_RESIDENCY_S = 2.0
WAIT_IN_USE_S = 30.0  # an acquire inside a use, which may keep what it waits for
PRIORITY = 50
PRIORITY_MAX = 100
THRASH_WINDOW_S = (
    60.0  # two consumers that throw each other out within so long are switching too often
)
THRASH_HOLD_MAX_S = 30.0
AGEING_S_PER_POINT = 5.0  # one priority point per 5 s waited

# The ladder towards a holder
REVOKE_RESEND_S = 0.25
REVOKE_REMIND_S = 2.0
REVOKE_DEADLINE_S = 30.0

# Measurement
VERIFY_TIMEOUT_S = 10.0
VERIFY_POLL_S = (0.005, 0.020, 0.050)  # pauses between readings after a release: 5 → 20 → 50 ms
# how long each pause but the last is kept; drivers take 0.5-1.5 s, and this is what is waited for
VERIFY_POLL_UNTIL_S = (2.0, 5.0)
VERIFY_CONFIRM_S = 0.002  # after a reading that is on target: the second one, which has to agree
VERIFY_READING_SHARE = 0.5  # a slow GPU is not read more than this share of the time
VERIFY_SLOW_POLL_S = 0.5  # after a verdict that does not allow a grant
VERIFY_TOLERANCE_BYTES = 64 * MIB  # allocator granularity and driver bookkeeping
PROBE_DEADLINE_S = 2.0
PROBE_PERIOD_S = 1.0  # background readings while there are leases or waiters
LOAD_PROBE_S = 0.05  # readings while a lease loads: its peak is learned from them
SAMPLE_MAX_AGE_S = 2.0  # an older sample does not gate a grant
RESERVE_BYTES = 300 * MIB
RESIDUE_BYTES = 450 * MIB  # a live CUDA process keeps its context

# Limits
MESSAGE_MAX_BYTES = 1 * MIB
IMAGE_MESSAGE_MAX_BYTES = 16 * MIB  # sidecar and runner wires only
VALUES_MAX = (
    6144  # msgpack values of one message, at every depth: at most 4 ms of decoding and validating
)
LISTED_MAX = 256  # keys of one map, items of one list
CONNECTIONS_MAX = 2048  # with those that have not said hello
SESSIONS_MAX = 1024
OPERATOR_RESERVE = 16  # sessions that only operators get
WAITERS_MAX = 16_384
LEASES_PER_CLIENT_MAX = 64
DEMANDS_MAX = 256  # consumers whose requests a status counts: 300 kB at most, 30 kB as a rule
USES_PER_LEASE_MAX = 256
PROCESS_SHARE = 1 / 8  # of the places of a limit that all share: the most that one process may take
USER_SHARE = 3 / 4  # the most that the processes of one user may take together
PRIORITY_RESERVE = 1 / 16  # of the places for waiters: kept for requests above the default priority
STATUS_PAGE = 200  # leases in one reply to `status`: about 2 ms
STATUS_DETAILS_PAGE = 32  # the same with details: each waiter costs an answer to `why`
RATE_PER_CLIENT_PER_S = 2000
RATE_PER_PROCESS_PER_S = 4000
SUBSCRIBERS_MAX = 64
HISTORY_MAX_EVENTS = 200_000
HISTORY_DAYS = 7
RECORD_MAX_BYTES = 64 * MIB  # about a quarter of a million events
RECORD_FILE_BYTES = 8 * MIB
HEARTBEAT_S = 2.0
NAME_MAX_CHARS = 128
REASON_MAX_CHARS = 512
