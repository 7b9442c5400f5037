"""What a task came to, as it is written to files and told to clients. Pure."""

from vram_arbiter.reasoner.planner import Episode, Finish
from vram_arbiter.schemas.reasoner import Result
from vram_arbiter.schemas.tools import QueryScene


def nothing_done(task: str, reason: str) -> Result:
    """Return the result of a task that ended without an episode, or broke one off."""
    return result_of(Episode(task), Finish(False, reason), frozenset(), stopped=False)


def result_of(
    episode: Episode, finish: Finish, manipulation: frozenset[str], *, stopped: bool
) -> Result:
    """Return the result of an episode.

    `manipulation` names the skills whose goals are attempts; `stopped`: a danger ended it.
    """
    answers = [
        step.outcome.text
        for step in episode.steps
        if isinstance(step.call, QueryScene) and step.outcome.status == "answered"
    ]
    return {
        "task": episode.task,
        "status": "success" if finish.success else "failure",
        "reason": finish.reason,
        "stopped": stopped,
        "attempts": episode.attempts(manipulation),
        "vlm_confirmed": episode.confirmed(manipulation),
        "vlm_answers": answers,
        "steps": [
            {
                "call": step.call.model_dump(exclude_defaults=True) | {"tool": step.call.tool},
                "status": step.outcome.status,
                "code": step.outcome.code,
                "text": step.outcome.text,
            }
            for step in episode.steps
        ],
        "notes": [
            {"source": note.source, "text": note.text, "after": note.after}
            for note in episode.notes
        ],
    }
