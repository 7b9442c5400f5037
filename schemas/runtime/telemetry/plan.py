"""What telemetry is asked for, by the environment and a program's configuration.

The SDK and its exporters read the OTEL_* variables themselves; this module reads only those that
say whether and where to export. Exporters are the installed entry points of the specification's
names (`otlp`, `console`, ...). Must not import the SDK.
"""

import ipaddress
import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, Literal

from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.urls import collector_url

type Signal = Literal["traces", "metrics", "logs"]
SIGNALS: tuple[Signal, ...] = ("traces", "metrics", "logs")
EXTRA = "vram-arbiter[telemetry]"
PROMETHEUS_PORT = 9464
"""Port that OpenTelemetry's specification gives to a Prometheus endpoint."""
_PROTOCOLS = {"": "http", "http/protobuf": "http", "grpc": "grpc"}


@dataclass(frozen=True, slots=True)
class Plan:
    """What is exported, by names of exporters. All empty: telemetry is off."""

    traces: tuple[str, ...] = ()
    metrics: tuple[str, ...] = ()
    endpoint: str | None = None
    """Base URL of the OTLP collector, from a configuration; None: the SDK reads the variables."""
    prometheus: tuple[str, int] | None = None
    """Loopback address and port; port 0 chooses a free one."""
    ratio: float | None = None
    """Share of traces that begin here; None: the SDK reads the variables."""
    logs: tuple[str, ...] = ()

    @property
    def on(self) -> bool:
        return bool(self.traces or self.metrics or self.logs) or self.prometheus is not None


def plan(
    environ: Mapping[str, str],
    *,
    endpoint: str | None = None,
    prometheus_port: int | None = None,
    sample_ratio: float | None = None,
) -> Plan:
    """Return what is asked for; import and open nothing. Raises ConfigError."""
    if environ.get("OTEL_SDK_DISABLED", "").strip().lower() == "true":
        return Plan()
    wanted = {signal: _exporters(environ, signal, endpoint) for signal in SIGNALS}
    prometheus = None
    if prometheus_port is not None or "prometheus" in wanted["metrics"]:
        prometheus = _prometheus(environ, prometheus_port)
    metrics = tuple(name for name in wanted["metrics"] if name != "prometheus")
    return Plan(wanted["traces"], metrics, endpoint, prometheus, sample_ratio, wanted["logs"])


def _exporters(environ: Mapping[str, str], signal: Signal, endpoint: str | None) -> tuple[str, ...]:
    """Return the exporters' names. An OTLP endpoint alone asks for `otlp`."""
    given = environ.get(f"OTEL_{signal.upper()}_EXPORTER", "").lower().split(",")
    names = tuple(name.strip() for name in given if name.strip())
    urls = [
        variable
        for variable in (
            f"OTEL_EXPORTER_OTLP_{signal.upper()}_ENDPOINT",
            "OTEL_EXPORTER_OTLP_ENDPOINT",
        )
        if environ.get(variable, "").strip()
    ]
    if not names and (urls or endpoint is not None):
        names = ("otlp",)
    for variable in urls if "otlp" in names else ():
        try:
            collector_url(environ[variable].strip())
        except ValueError as error:
            raise ConfigError(f"{variable}: {error}", hint="or unset it") from None
    return tuple(name for name in names if name != "none")


def _prometheus(environ: Mapping[str, str], port: int | None) -> tuple[str, int]:
    host = environ.get("OTEL_EXPORTER_PROMETHEUS_HOST", "").strip() or "127.0.0.1"
    if not _is_loopback(host):
        raise ConfigError(
            f"OTEL_EXPORTER_PROMETHEUS_HOST: expected a loopback address, got {host}; the endpoint"
            " does not authenticate",
            hint="write 127.0.0.1 and let a collector or proxy on this machine forward it",
        )
    if port is None:
        text = environ.get("OTEL_EXPORTER_PROMETHEUS_PORT", "").strip() or str(PROMETHEUS_PORT)
        if not text.isascii() or not text.isdigit() or int(text) > 65_535:
            raise ConfigError(
                f"OTEL_EXPORTER_PROMETHEUS_PORT: expected a port, got {text!r}", hint="0 to 65535"
            )
        port = int(text)
    return host, port


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def check(planned: Plan) -> None:
    """Raise ConfigError for an exporter that `set_up` could not make; import no SDK."""
    try:
        for name in planned.traces:
            entry_point("traces", name)
        for name in planned.metrics:
            entry_point("metrics", name)
        for name in planned.logs:
            entry_point("logs", name)
        if planned.prometheus is not None and find_spec("prometheus_client") is None:
            raise ImportError("No module named 'prometheus_client'")
    except ImportError as error:
        raise not_installed(error) from error


def not_installed(error: ImportError) -> ConfigError:
    return ConfigError(
        f"telemetry is asked for, but its packages are not installed: {error}",
        hint=f"pip install '{EXTRA}', or unset the OTEL_ variables and the telemetry section",
    )


def entry_point(signal: Signal, name: str) -> Any:
    """Return an installed exporter's entry point by its name in the specification."""
    from importlib.metadata import entry_points

    entry = f"otlp_proto_{_protocol(signal)}" if name == "otlp" else name
    found = tuple(entry_points(group=f"opentelemetry_{signal}_exporter", name=entry))
    if found:
        return found[0]
    if name == "otlp":
        raise ImportError(f"no exporter {entry!r} is installed")
    raise ConfigError(
        f"OTEL_{signal.upper()}_EXPORTER: no exporter {name!r} is installed",
        hint="write otlp, prometheus (metrics only) or none, or install its package",
    )


def _protocol(signal: Signal) -> str:
    for variable in (
        f"OTEL_EXPORTER_OTLP_{signal.upper()}_PROTOCOL",
        "OTEL_EXPORTER_OTLP_PROTOCOL",
    ):
        if given := os.environ.get(variable, "").strip().lower():
            if given not in _PROTOCOLS:
                raise ConfigError(
                    f"{variable}: expected http/protobuf or grpc, got {given!r}",
                    hint="collectors take http/protobuf on port 4318",
                )
            return _PROTOCOLS[given]
    return _PROTOCOLS[""]
