"""All errors that cross a process border: one tree, one table from wire codes to types.

The type says who must act: `CallerError` (the program that asked), `OperatorError` (a person),
`TransientError` (wait or retry), `InternalError` (us).
"""

from typing import ClassVar

from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.schemas.wire.errors import ErrorView

CODES: dict[str, type["VramError"]] = {}
"""Wire code → type."""


class VramError(Exception):
    """Root of the product's errors.

    `code` is stable and goes over the wire, `message` says what happened, `hint` what to do,
    `details` the numbers.
    """

    code: ClassVar[str] = "internal"

    def __init_subclass__(cls, *, code: str = "") -> None:
        if code:
            cls.code = code
            CODES[code] = cls

    def __init__(self, message: str, *, hint: str = "", details: JsonMap | None = None) -> None:
        super().__init__(f"{message} ({hint})" if hint else message)
        self.message = message
        self.hint = hint
        self.details: Message = dict(details or {})

    def view(self) -> ErrorView:
        """The `error` of a reply."""
        return ErrorView(self.code, self.message, self.hint, self.details)

    def to_wire(self) -> Message:
        """The `error` map of a reply."""
        return to_map(self.view())


class CallerError(VramError):
    """The calling program asked for something it must not or cannot ask for."""


class OperatorError(VramError):
    """A person has to change a file, a flag or the machine."""


class TransientError(VramError):
    """Time or a retry helps."""


class InternalError(VramError):
    """A defect of ours; the story is in the details."""


# -- the wire itself
class BadFrame(CallerError, code="bad_frame"):
    """The frame is not a msgpack map."""


class BadRequest(CallerError, code="bad_request"):
    """A field is missing, unknown or wrong; `details.fields` lists them."""


class UnknownOp(CallerError, code="unknown_op"):
    """There is no such request; `details.known` lists those that exist."""


class MessageTooLarge(CallerError, code="message_too_large"):
    """The message exceeds a limit; the message names it."""


class VersionMismatch(CallerError, code="version_mismatch"):
    """Client and server speak different versions of the wire."""


class UnknownSession(TransientError, code="unknown_session"):
    """No hello yet, or the arbiter restarted: say hello and reattach."""


class NotPermitted(CallerError, code="not_permitted"):
    """The role or the process does not allow it."""


class LimitExceeded(CallerError, code="limit_exceeded"):
    """A limit of clients, leases, uses, waiters or requests a second; `details.limit` names
    it."""


class RemoteMayNotHold(NotPermitted, code="remote_may_not_hold"):
    """A guest asked for a lease: what needs the GPU runs on its machine, and holds the lease
    there."""


# -- leases
class VramInsufficient(CallerError, code="vram_insufficient"):
    """It can never fit: `details.needed_bytes`, `capacity_bytes`, `reserve_bytes`."""


class HostRamInsufficient(TransientError, code="host_ram_insufficient"):
    """No host RAM is left to park: `details.needed_bytes`, `budget_bytes`, `booked_bytes`."""


class LoadFailing(TransientError, code="load_failing"):
    """Its loads failed several times in a row, and it needs an eviction: `details.retry_in_s`,
    `cause`."""


class WouldDeadlock(CallerError, code="would_deadlock"):
    """An acquire inside a use of this process waited 30 s: it may wait for what that use keeps.
    `details.uses` names the uses."""


class UnknownGpu(CallerError, code="unknown_gpu"):
    """No GPU has this UUID or index."""


class UnknownLease(CallerError, code="unknown_lease"):
    """No lease has this id or consumer."""


class StaleToken(CallerError, code="stale_token"):
    """The lease was granted again, or never to this client."""


class LeaseRevoking(TransientError, code="lease_revoking"):
    """The holder was revoked: no new use begins."""


class LeaseExpired(CallerError, code="lease_expired"):
    """The lease was not renewed within its TTL: acquire again."""


class LeaseLost(CallerError, code="lease_lost"):
    """The lease was revoked, expired or fenced: acquire again."""


class BadState(CallerError, code="bad_state"):
    """The request does not fit the lease's state; `details.story` has its last changes."""


class WaitTimeout(TransientError, code="wait_timeout"):
    """The wait's own time limit ended; `details.why` explains what blocked."""


class Cancelled(CallerError, code="cancelled"):
    """It was canceled or stopped before it was done."""


class JournalUnavailable(OperatorError, code="journal_unavailable"):
    """The journal cannot be written: nothing is granted until it can."""


# -- the daemon
class ArbiterUnreachable(TransientError, code="arbiter_unreachable"):
    """The arbiter does not answer: not running, hanging, or another socket."""


class UntrustedServer(OperatorError, code="untrusted_server"):
    """Another user's process serves the socket: `details.uid`, `user`, `endpoint`."""


class AlreadyRunning(OperatorError, code="already_running"):
    """Another arbiter serves the socket or uses the state folder."""


class ConfigError(OperatorError, code="config_error"):
    """A flag, a file or a variable is wrong; `details.fields` has path, line and problem."""


class UnsupportedQuantization(ConfigError, code="unsupported_quantization"):
    """Device or program cannot compute in this number format: `details.dtype`, `supported`."""


class NoGpu(OperatorError, code="no_gpu"):
    """There is no driver, no GPU, or not the one that is asked for."""


class ProbeFailed(TransientError, code="probe_failed"):
    """A GPU could not be read, or answered nonsense."""


# -- sidecars
class Evicted(TransientError, code="evicted"):
    """The model left the GPU; never to be read as "object not found"."""


class NotResident(TransientError, code="not_resident"):
    """The model is not on the GPU, and the request does not load it."""


class Loading(TransientError, code="loading"):
    """The model loads."""


class ModelError(CallerError, code="model_error"):
    """The model failed at this request, or does not answer."""


class OutOfMemory(TransientError, code="oom"):
    """The GPU was full, real or simulated."""


class SidecarUnavailable(TransientError, code="sidecar_unavailable"):
    """A sidecar cannot be started or reached: `details.endpoint`."""


class CalibrationFailed(OperatorError, code="calibration_failed"):
    """A footprint could not be measured: `details.exit_code` of a program that failed."""


# -- programs that know nothing of the arbiter
class InstallFailed(OperatorError, code="install_failed"):
    """`vramctl install`: a command of the machine, or a file."""


class ActionFailed(TransientError, code="action_failed"):
    """A program did not free or restore its memory: `details.url`, `status`."""


class CheckpointUnsupported(OperatorError, code="checkpoint_unsupported"):
    """Driver, architecture, package or privileges do not allow suspending a program."""


# -- the gateway of model servers
class UnknownModel(CallerError, code="unknown_model"):
    """No server behind the gateway has a model of this name; `details.models` lists them."""


class KeyRefused(CallerError, code="key_refused"):
    """No API key was shown, or none that the gateway knows."""


# -- runner and reasoner
class RunnerUnreachable(TransientError, code="runner_unreachable"):
    """The runner does not answer: not running, or hanging."""


class ReasonerUnreachable(TransientError, code="reasoner_unreachable"):
    """No reasoner runs there, or it hangs."""


class GoalRejected(CallerError, code="goal_rejected"):
    """The goal does not fit the robot, the skill or the moment, or was not reached."""


class PathToleranceViolated(CallerError, code="path_tolerance_violated"):
    """A joint left its trajectory by more than the goal allows."""


class EstopRequested(OperatorError, code="estop_requested"):
    """The emergency stop is latched: look at the robot, then start the runner again."""


class RobotFault(OperatorError, code="robot_fault"):
    """The robot does not answer, or answers nonsense: cables, power, calibration."""


class EnvironmentFailed(OperatorError, code="environment_failed"):
    """A simulated world raised, or reported what cannot be: its own code or packages."""


class FrameStale(TransientError, code="frame_stale"):
    """No camera frame is young enough."""


class StateStale(TransientError, code="state_stale"):
    """The robot does not report, or no longer reports, where its joints are."""


class UnknownSkill(CallerError, code="unknown_skill"):
    """No installed skill has this name."""


class ManifestInvalid(OperatorError, code="manifest_invalid"):
    """A skill's manifest is wrong; the message lists the findings."""


class LlmError(TransientError, code="llm_error"):
    """The language model failed, or its answers cannot be read."""


def from_wire(error: JsonMap) -> VramError:
    """Rebuild the typed error of a reply; an unknown code (a newer server) becomes InternalError
    with the code kept."""
    cls = CODES.get(str(error.get("code")), InternalError)
    details = dict(error.get("details") or {})
    if cls is InternalError:
        details.setdefault("code", error.get("code"))
    return cls(str(error.get("message", "")), hint=str(error.get("hint", "")), details=details)
