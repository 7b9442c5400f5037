"""The reasoner's wire: what a person says to a running episode, on one ZeroMQ ROUTER socket.

Request {"op": …, "id": n, …} → reply {"re": n, "ok": true, …} | {"re": n, "ok": false, "error":
{…}}. Nothing here moves anything: words reach the planner, a cancel ends the episode and its goal.
"""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter


class _Call(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")
    id: Annotated[int, Field(ge=0, lt=1 << 53)]


class Say(_Call):
    """Words for the planner, also while a goal runs."""

    op: Literal["say"]
    text: Annotated[str, Field(min_length=1, max_length=2000)]


class CancelEpisode(_Call):
    """End the episode: its goal is cancelled, the planner is not asked."""

    op: Literal["cancel"]
    reason: Annotated[str, Field(max_length=500)] = ""


class GetEpisode(_Call):
    """Which task it works on, and its process."""

    op: Literal["state"]


class PingReasoner(_Call):
    op: Literal["ping"]


ReasonerRequest = Annotated[
    Say | CancelEpisode | GetEpisode | PingReasoner, Field(discriminator="op")
]
REASONER_REQUEST: TypeAdapter[ReasonerRequest] = TypeAdapter(ReasonerRequest)
OPS = ("say", "cancel", "state", "ping")
