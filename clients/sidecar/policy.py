"""Client of a policy sidecar (endpoint family): load, reset, get_action. Arrays travel as .npy
(`clients.sidecar.npy`)."""

from collections.abc import Sequence

from vram_arbiter.clients.sidecar import npy
from vram_arbiter.clients.sidecar.base import SidecarClient
from vram_arbiter.schemas.errors import ModelError
from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.schemas.sidecar import RealTimeChunking


class PolicyClient(SidecarClient):
    """`load` gives lease id and token; a goal marks a use with them at the arbiter and sends the
    token with every call."""

    family = "endpoint"

    async def reset(
        self,
        data: JsonMap | None = None,
        *,
        token: Sequence[int] | None = None,
    ) -> Message:
        """Forget the episode so far; the answer may say what the next one takes (`ResetResult`).
        Raises Evicted, NotResident, SidecarUnavailable."""
        fields = {"data": npy.pack(dict(data or {}))}
        result = await self.call("reset", fields, token=token)
        return result if isinstance(result, dict) else {}

    async def get_action(
        self,
        observation: JsonMap,
        *,
        rtc: RealTimeChunking | None = None,
        whole_chunk: bool = False,
        afresh: bool = False,
        fresh_s: float | None = None,
        token: Sequence[int] | None = None,
    ) -> Message:
        """The next actions by name, e.g. `{"action": array of shape (steps, joints)}`: those that
        are played before it is asked again, or the `whole_chunk`.

        `rtc` says what they shall continue; a policy that cannot be guided refuses it (BadRequest).
        `afresh`: whatever was asked before is forgotten, and `n_obs_steps` is among the names.
        Raises Evicted when the sidecar holds another lease than `token`'s, FrameStale after
        `fresh_s`, ModelError, OutOfMemory, SidecarUnavailable.
        """
        data = {"observation": npy.pack(dict(observation))}
        fields: Message = {"data": data} | ({"rtc": rtc.model_dump()} if rtc is not None else {})
        if whole_chunk:
            fields["whole_chunk"] = True
        if afresh:
            fields["afresh"] = True
        result = npy.unpack(await self.call("get_action", fields, token=token, fresh_s=fresh_s))
        if isinstance(result, list) and result:  # the field's servers answer [actions, info]
            result = result[0]
        if not isinstance(result, dict):
            raise ModelError(f"get_action answered a {type(result).__name__}, not a map of actions")
        result.pop("ok", None)
        return result
