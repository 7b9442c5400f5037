"""What a runner sees and does as a Rerun recording: for a viewer, or in a file.

`rerun` is imported when a stream is made; it is lerobot's visualizer (extra `viz`). Entities:
`camera/NAME`, `state/JOINT`, `action/JOINT`, `base/…`, `tick/…`, `leases/NAME`, `goal`, `events`,
on the timelines `time` and `tick`. Must not know threads, robots or sockets.
"""

from __future__ import annotations

import time
from collections.abc import Mapping

from vram_arbiter.runner.protocols import GoalTick
from vram_arbiter.runner.sensors.pictures import COLOURS, as_rgb, encode
from vram_arbiter.schemas.errors import ConfigError, FrameStale, ModelError
from vram_arbiter.schemas.runtime.extras import need
from vram_arbiter.schemas.world import FrameEncoding, SensorFrame, WorldState

APPLICATION = "vram-runner"
RERUN = "rerun"
GIB = 1 << 30
SPAWN_S = 30.0  # a viewer opens its window and its port
ANSWER_S = 5.0


def check_display(target: str) -> None:
    """Raise ConfigError for a target that is not one, or without the packages."""
    if target != RERUN and not target.startswith(f"{RERUN}+http") and not target.endswith(".rrd"):
        raise ConfigError(
            f"--display {target}: expected rerun, rerun+http://HOST:PORT/proxy or FILE.rrd"
        )
    need("--display", "rerun", "cv2", extra="viz")


class RerunStream:
    """One recording. `target`: `rerun` starts a viewer, `rerun+http://…/proxy` connects to one, a
    path ending in `.rrd` is written. Calls on one thread.

    Raises ConfigError for a viewer that does not answer.
    """

    def __init__(self, target: str, name: str) -> None:
        import rerun

        rerun.unregister_shutdown()  # at exit it waits for ever for a viewer that hangs
        self._rerun = rerun
        self._stream = rerun.RecordingStream(APPLICATION, recording_id=None)
        self._stream.send_recording_name(name)
        if target == RERUN:
            self._stream.spawn(memory_limit="10%", hide_welcome_screen=True)
            self._reach("the Rerun viewer does not start", SPAWN_S)
        elif target.endswith(".rrd"):
            self._stream.save(target)
        else:
            self._stream.connect_grpc(target)
            self._reach(f"no Rerun viewer answers at {target}", 0.0)

    def _reach(self, failure: str, within_s: float) -> None:
        give_up = time.monotonic() + within_s
        while True:
            try:
                self._stream.flush(timeout_sec=ANSWER_S)
                return
            except RuntimeError as error:
                if time.monotonic() < give_up:
                    continue
                self._stream.disconnect()
                raise ConfigError(
                    f"{failure}: {error}", hint="start `rerun`, or write a file: --display FILE.rrd"
                ) from error

    def close(self) -> None:
        """Finish the file, or send the rest to the viewer. Raises ConfigError if it is lost."""
        try:
            self._stream.flush(timeout_sec=ANSWER_S)
        except RuntimeError as error:
            raise ConfigError(f"the viewer did not take everything: {error}") from error
        finally:
            self._stream.disconnect()

    # -- what is shown
    def at(self, time_s: float, tick: int | None = None) -> None:
        """Set the time of what is shown next."""
        self._stream.set_time("time", duration=time_s)
        if tick is not None:
            self._stream.set_time("tick", sequence=tick)

    def numbers(self, group: str, values: Mapping[str, float]) -> None:
        """Show one number by name each."""
        for name, value in values.items():
            self._stream.log(f"{group}/{name}", self._rerun.Scalars([value]))

    def event(self, text: str, level: str = "INFO") -> None:
        """Show a line of the log."""
        self._stream.log("events", self._rerun.TextLog(text, level=level))

    def goal(self, text: str) -> None:
        """Show what the robot is doing, in place of what it did before."""
        self._stream.log("goal", self._rerun.TextDocument(text))

    def frames(self, frames: Mapping[str, SensorFrame]) -> None:
        """Show the cameras' pictures; those without colors are left out."""
        for camera, frame in frames.items():
            if frame.data is None or frame.encoding not in COLOURS:
                continue
            jpeg = frame.data
            try:
                if frame.encoding is not FrameEncoding.JPEG:
                    jpeg = encode(as_rgb(frame), "jpeg")
            except (FrameStale, ModelError) as error:
                self.event(f"camera {camera}: {error.message}", "WARN")
                continue
            image = self._rerun.EncodedImage(contents=jpeg, media_type="image/jpeg")
            self._stream.log(f"camera/{camera}", image)

    def world(self, world: WorldState) -> None:
        """Show a state of the world."""
        joints = world.joint_state
        self.numbers("state", dict(zip(joints.name, joints.position, strict=True)))
        if world.base_pose is not None:
            self.numbers("base", dict(zip("xyz", world.base_pose.xyz, strict=True)))
        self.frames(world.image_frames or {})

    def tick(self, tick: GoalTick) -> None:
        """Show a tick of a goal: what was seen, what the motors were told, what was withheld."""
        result = tick.result
        self.at(tick.world.stamp_ns / 1e9, result.tick_idx)
        self.world(tick.world)
        self.numbers("action", tick.targets)
        if tick.base_velocity is not None:
            self.numbers(
                "action/base", dict(zip(("vx", "vy", "wz"), tick.base_velocity, strict=True))
            )
        withheld = bool(result.safety_violations) and not result.action_applied
        timings = {"ms": result.tick_ms, "inference_ms": result.inference_ms}
        self.numbers("tick", {**timings, "withheld": float(withheld)})
        for text in result.safety_violations:
            self.event(f"withheld: {text}" if withheld else text, "WARN")

    def leases(self, charged: Mapping[str, float]) -> None:
        """Show the bytes that leases are charged, by holder, as GiB."""
        self.numbers("leases", {name: size / GIB for name, size in charged.items()})
