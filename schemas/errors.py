"""All errors that cross a process border: one tree, one table from wire codes to types.

The type says who must act: `CallerError` (the program that asked), `OperatorError` (a person),
`TransientError` (wait or retry), `InternalError` (us).
"""

from typing import ClassVar

from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.schemas.wire.errors import ErrorView


class VramError(Exception):
    """Root of the product's errors.

    `code` is stable and goes over the wire, `message` says what happened, `hint` what to do,
    `details` the numbers.
    """

    code: ClassVar[str] = "internal"

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
        return {
            "code": self.code,
            "message": self.message,
            "hint": self.hint,
            "details": self.details,
        }


class CallerError(VramError):
    """The calling program asked for something it must not or cannot ask for."""


class OperatorError(VramError):
    """A person has to change a file, a flag or the machine."""


class TransientError(VramError):
    """Time or a retry helps."""


class InternalError(VramError):
    """A defect of ours; the story is in the details."""


# -- the wire itself
class BadFrame(CallerError):
    """The frame is not a msgpack map."""

    code = "bad_frame"


class BadRequest(CallerError):
    """A field is missing, unknown or wrong; `details.fields` lists them."""

    code = "bad_request"


class UnknownOp(CallerError):
    """There is no such request; `details.known` lists those that exist."""

    code = "unknown_op"


class MessageTooLarge(CallerError):
    """The message exceeds a limit; the message names it."""

    code = "message_too_large"


class VersionMismatch(CallerError):
    """Client and server speak different versions of the wire."""

    code = "version_mismatch"


class UnknownSession(TransientError):
    """No hello yet, or the arbiter restarted: say hello and reattach."""

    code = "unknown_session"


class NotPermitted(CallerError):
    """The role or the process does not allow it."""

    code = "not_permitted"


class LimitExceeded(CallerError):
    """A limit of clients, leases, uses, waiters or requests a second; `details.limit` names
    it."""

    code = "limit_exceeded"


# -- leases
class VramInsufficient(CallerError):
    """It can never fit: `details.needed_bytes`, `capacity_bytes`, `reserve_bytes`."""

    code = "vram_insufficient"


class HostRamInsufficient(TransientError):
    """No host RAM is left to park: `details.needed_bytes`, `budget_bytes`, `booked_bytes`."""

    code = "host_ram_insufficient"


class LoadFailing(TransientError):
    """Its loads failed several times in a row, and it needs an eviction: `details.retry_in_s`,
    `cause`."""

    code = "load_failing"


class WouldDeadlock(CallerError):
    """An acquire inside a use of this process waited 30 s: it may wait for what that use keeps.
    `details.uses` names the uses."""

    code = "would_deadlock"


class UnknownGpu(CallerError):
    """No GPU has this UUID or index."""

    code = "unknown_gpu"


class UnknownLease(CallerError):
    """No lease has this id or consumer."""

    code = "unknown_lease"


class StaleToken(CallerError):
    """The lease was granted again, or never to this client."""

    code = "stale_token"


class LeaseRevoking(TransientError):
    """The holder was revoked: no new use begins."""

    code = "lease_revoking"


class LeaseExpired(CallerError):
    """The lease was not renewed within its TTL: acquire again."""

    code = "lease_expired"


class LeaseLost(CallerError):
    """The lease was revoked, expired or fenced: acquire again."""

    code = "lease_lost"


class BadState(CallerError):
    """The request does not fit the lease's state; `details.story` has its last changes."""

    code = "bad_state"


class WaitTimeout(TransientError):
    """The wait's own time limit ended; `details.why` explains what blocked."""

    code = "wait_timeout"


class Cancelled(CallerError):
    """It was canceled or stopped before it was done."""

    code = "cancelled"


class JournalUnavailable(OperatorError):
    """The journal cannot be written: nothing is granted until it can."""

    code = "journal_unavailable"


# -- the daemon
class ArbiterUnreachable(TransientError):
    """The arbiter does not answer: not running, hanging, or another socket."""

    code = "arbiter_unreachable"


class UntrustedServer(OperatorError):
    """Another user's process serves the socket: `details.uid`, `user`, `endpoint`."""

    code = "untrusted_server"


class AlreadyRunning(OperatorError):
    """Another arbiter serves the socket or uses the state folder."""

    code = "already_running"


class ConfigError(OperatorError):
    """A flag, a file or a variable is wrong; `details.fields` has path, line and problem."""

    code = "config_error"


class UnsupportedQuantization(ConfigError):
    """Device or program cannot compute in this number format: `details.dtype`, `supported`."""

    code = "unsupported_quantization"


class NoGpu(OperatorError):
    """There is no driver, no GPU, or not the one that is asked for."""

    code = "no_gpu"


class ProbeFailed(TransientError):
    """A GPU could not be read, or answered nonsense."""

    code = "probe_failed"


# -- sidecars
class Evicted(TransientError):
    """The model left the GPU; never to be read as "object not found"."""

    code = "evicted"


class NotResident(TransientError):
    """The model is not on the GPU, and the request does not load it."""

    code = "not_resident"


class Loading(TransientError):
    """The model loads."""

    code = "loading"


class ModelError(CallerError):
    """The model failed at this request, or does not answer."""

    code = "model_error"


class OutOfMemory(TransientError):
    """The GPU was full, real or simulated."""

    code = "oom"


class SidecarUnavailable(TransientError):
    """A sidecar cannot be started or reached: `details.endpoint`."""

    code = "sidecar_unavailable"


class CalibrationFailed(OperatorError):
    """A footprint could not be measured: `details.exit_code` of a program that failed."""

    code = "calibration_failed"


# -- programs that know nothing of the arbiter
class InstallFailed(OperatorError):
    """`vramctl install`: a command of the machine, or a file."""

    code = "install_failed"


class ActionFailed(TransientError):
    """A program did not free or restore its memory: `details.url`, `status`."""

    code = "action_failed"


class CheckpointUnsupported(OperatorError):
    """Driver, architecture, package or privileges do not allow suspending a program."""

    code = "checkpoint_unsupported"


# -- runner and reasoner
class RunnerUnreachable(TransientError):
    """The runner does not answer: not running, or hanging."""

    code = "runner_unreachable"


class ReasonerUnreachable(TransientError):
    """No reasoner runs there, or it hangs."""

    code = "reasoner_unreachable"


class GoalRejected(CallerError):
    """The goal does not fit the robot, the skill or the moment, or was not reached."""

    code = "goal_rejected"


class EstopRequested(OperatorError):
    """The emergency stop is latched: look at the robot, then start the runner again."""

    code = "estop_requested"


class RobotFault(OperatorError):
    """The robot does not answer, or answers nonsense: cables, power, calibration."""

    code = "robot_fault"


class EnvironmentFailed(OperatorError):
    """A simulated world raised, or reported what cannot be: its own code or packages."""

    code = "environment_failed"


class FrameStale(TransientError):
    """No camera frame is young enough."""

    code = "frame_stale"


class StateStale(TransientError):
    """The robot does not report, or no longer reports, where its joints are."""

    code = "state_stale"


class UnknownSkill(CallerError):
    """No installed skill has this name."""

    code = "unknown_skill"


class ManifestInvalid(OperatorError):
    """A skill's manifest is wrong; the message lists the findings."""

    code = "manifest_invalid"


class LlmError(TransientError):
    """The language model failed, or its answers cannot be read."""

    code = "llm_error"


def _leaves(cls: type[VramError]) -> list[type[VramError]]:
    found = [cls] if "code" in cls.__dict__ and cls is not VramError else []
    for child in cls.__subclasses__():
        found += _leaves(child)
    return found


CODES: dict[str, type[VramError]] = {cls.code: cls for cls in _leaves(VramError)}
"""Wire code → type."""


def from_wire(error: JsonMap) -> VramError:
    """Rebuild the typed error of a reply; an unknown code (a newer server) becomes InternalError
    with the code kept."""
    cls = CODES.get(str(error.get("code")), InternalError)
    details = dict(error.get("details") or {})
    if cls is InternalError:
        details.setdefault("code", error.get("code"))
    return cls(str(error.get("message", "")), hint=str(error.get("hint", "")), details=details)
