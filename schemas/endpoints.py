"""Where the sockets are. Pure: callers pass their environment in."""

from collections.abc import Mapping

ENDPOINT_VARIABLE = "VRAM_ARBITER_ENDPOINT"
RUNTIME_VARIABLE = "VRAM_ARBITER_RUNTIME"
SYSTEM_RUNTIME = "/run/vram-arbiter"  # of the units in configs/systemd/system


def runtime_dir(environ: Mapping[str, str], uid: int) -> str:
    """Folder of all sockets: explicit, under systemd, under the login session, else per user below /tmp."""
    if explicit := environ.get(RUNTIME_VARIABLE):
        return explicit
    if under_systemd := environ.get("RUNTIME_DIRECTORY"):
        return under_systemd.split(":")[0]  # systemd joins several directories with colons
    if session := environ.get("XDG_RUNTIME_DIR"):
        return f"{session}/vram-arbiter"
    return f"/tmp/vram-arbiter-{uid}"


def arbiter_endpoint(environ: Mapping[str, str], uid: int) -> str:
    """Endpoint of the arbiter: `VRAM_ARBITER_ENDPOINT`, else `arbiter.sock` in the runtime folder."""
    return environ.get(ENDPOINT_VARIABLE) or f"ipc://{runtime_dir(environ, uid)}/arbiter.sock"


def program_endpoint(name: str, environ: Mapping[str, str], uid: int) -> str:
    """Endpoint of a sidecar or of the runner, by its name: `ipc://<runtime>/<name>.sock`."""
    return f"ipc://{runtime_dir(environ, uid)}/{name}.sock"
