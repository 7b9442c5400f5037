"""What happens in a demo, one line each: events of the arbiter, and what the robot does. `vramctl
top` shows the rest live.
"""

from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.printable import printable

QUIET_KINDS = frozenset(
    {"use_began", "use_ended", "queued", "revoke_acked", "released", "probe_ok"}
)


def describe(event: JsonMap) -> str:
    """One history event as a sentence, without its time."""
    who = str(event.get("consumer", event.get("lease_id", "")))
    match event["kind"]:
        case "revoke_asked":
            return f"{who}: revoked ({event.get('reason', '')})"
        case "verified":
            return (
                f"{who}: memory measured back, verdict {event.get('verdict')} after "
                f"{event.get('verify_ms', event.get('ms', 0)):.0f} ms"
            )
        case "switch" if event["switched"]:
            gone = ", ".join(victim["consumer"] for victim in event["evicted"])
            return f"{who} took over from {gone} in {event['total_ms']:.0f} ms"
        case "switch":
            return f"{who} loaded beside the others in {event['load_ms']:.0f} ms, no eviction"
        case kind:
            reason = event.get("reason", "")
            return f"{who or 'arbiter'}: {kind}" + (f" ({reason})" if reason else "")


class Display:
    """Prints each thing once."""

    def __init__(self) -> None:
        self._robot = ""

    def say(self, text: str) -> None:
        print(printable(text), flush=True)

    def event(self, event: JsonMap, at_s: float) -> None:
        """A history event of the arbiter, `at_s` seconds after the start; none from before it."""
        if at_s >= 0.0 and event["kind"] not in QUIET_KINDS:
            self.say(f"{at_s:6.1f} s  {describe(event)}")

    def robot(self, line: str, at_s: float) -> None:
        """What the reasoner does now."""
        if line and line != self._robot:
            self._robot = line
            self.say(f"{at_s:6.1f} s  robot: {line}")
