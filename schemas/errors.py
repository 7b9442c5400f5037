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
    code = "bad_frame"  # not msgpack, not a map


class BadRequest(CallerError):
    code = "bad_request"  # a map, but with wrong fields; details.fields lists them


class UnknownOp(CallerError):
    code = "unknown_op"  # details.known lists the ops


class MessageTooLarge(CallerError):
    code = "message_too_large"


class VersionMismatch(CallerError):
    code = "version_mismatch"


class UnknownSession(TransientError):
    code = "unknown_session"  # no hello yet, or the arbiter restarted: say hello and re-attach


class NotPermitted(CallerError):
    code = "not_permitted"  # role or process does not allow it


class LimitExceeded(CallerError):
    code = "limit_exceeded"  # details.limit names it


# -- leases
class VramInsufficient(CallerError):
    code = "vram_insufficient"  # can never fit: details.needed_bytes, capacity_bytes, reserve_bytes


class HostRamInsufficient(TransientError):
    code = (
        "host_ram_insufficient"  # no room to park: details.needed_bytes, budget_bytes, booked_bytes
    )


class LoadFailing(TransientError):
    # its loads failed several times in a row, and an eviction would be needed: details.retry_in_s,
    # cause
    code = "load_failing"


class GangBroken(TransientError):
    # another member was denied, lost or gave up before all were granted: details.gang, why
    code = "gang_broken"


class WouldDeadlock(CallerError):
    # the wait is for what a use of this process keeps: details.cycle, the uses and waits in it
    code = "would_deadlock"


class UnknownGpu(CallerError):
    code = "unknown_gpu"


class UnknownLease(CallerError):
    code = "unknown_lease"


class StaleToken(CallerError):
    code = "stale_token"  # the lease was granted again or never to you


class LeaseRevoking(TransientError):
    code = "lease_revoking"  # the holder was asked to leave: no new use begins


class LeaseExpired(CallerError):
    code = "lease_expired"


class LeaseLost(CallerError):
    code = "lease_lost"  # revoked, expired or fenced: acquire again


class BadState(CallerError):
    code = "bad_state"  # the request does not fit the lease's state; details.story


class WaitTimeout(TransientError):
    code = "wait_timeout"  # details.why explains what blocked


class HolderBusy(TransientError):
    code = "holder_busy"  # deadline of the ladder passed under the policy `deny`


class Cancelled(CallerError):
    code = "cancelled"


class JournalUnavailable(OperatorError):
    code = "journal_unavailable"


# -- the daemon
class ArbiterUnreachable(TransientError):
    code = "arbiter_unreachable"


class UntrustedServer(OperatorError):
    code = (
        "untrusted_server"  # another user's process serves the socket: details.uid, user, endpoint
    )


class AlreadyRunning(OperatorError):
    code = "already_running"


class ConfigError(OperatorError):
    code = "config_error"  # details.fields: path, line, problem


class UnsupportedQuantization(ConfigError):
    # a number format that the device or this program cannot compute in: details.dtype, supported
    code = "unsupported_quantization"


class NoGpu(OperatorError):
    code = "no_gpu"


class ProbeFailed(TransientError):
    code = "probe_failed"


# -- sidecars
class Evicted(TransientError):
    code = "evicted"  # never to be read as "object not found"


class NotResident(TransientError):
    code = "not_resident"


class Loading(TransientError):
    code = "loading"


class ModelError(CallerError):
    code = "model_error"


class OutOfMemory(TransientError):
    code = "oom"  # the card was full: real or simulated


class SidecarUnavailable(TransientError):
    code = "sidecar_unavailable"  # cannot be started or reached; details.exit_code, log


class CalibrationFailed(OperatorError):
    # a footprint could not be measured; details.exit_code and log of a program that ended early
    code = "calibration_failed"


# -- programs that know nothing of the arbiter
class ActionFailed(TransientError):
    code = "action_failed"  # a program did not free or restore its memory; details.url, status


class CheckpointUnsupported(OperatorError):
    code = "checkpoint_unsupported"  # driver, architecture, package or privileges


# -- runner and reasoner
class RunnerUnreachable(TransientError):
    code = "runner_unreachable"  # it does not answer: not running, or hanging


class ReasonerUnreachable(TransientError):
    code = "reasoner_unreachable"  # no episode runs there, or it hangs


class GoalRejected(CallerError):
    code = "goal_rejected"


class EstopRequested(OperatorError):
    # the emergency stop is latched: a person looks, then starts the runner again
    code = "estop_requested"


class RobotFault(OperatorError):
    # the robot's hardware does not answer, or answers nonsense: cables, power, calibration
    code = "robot_fault"


class EnvironmentFailed(OperatorError):
    # a simulated world raised, or told what cannot be: its own code, or its packages
    code = "environment_failed"


class FrameStale(TransientError):
    code = "frame_stale"  # no frame young enough: fail closed


class StateStale(TransientError):
    code = "state_stale"  # the robot does not say, or no longer, where its joints are: fail closed


class UnknownSkill(CallerError):
    code = "unknown_skill"


class ManifestInvalid(OperatorError):
    code = "manifest_invalid"


class LlmError(TransientError):
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
