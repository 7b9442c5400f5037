"""Playbooks: written procedures that narrow what a planner may do and tell it how.

A playbook is not an executable skill: it is chosen for an episode. From then on only the tools that
it composes are available, its text is part of the instructions, and its `max_steps` ends the
episode. Only a language model can read one.
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from vram_arbiter.reasoner.palette import Palette
from vram_arbiter.schemas.errors import ConfigError, ManifestInvalid
from vram_arbiter.schemas.manifest import Kind, ManifestError, load_manifest
from vram_arbiter.schemas.manifest.contracts import PlaybookContract
from vram_arbiter.schemas.tools import TOOLS

BODY_MAX_BYTES = 16 * 1024


@dataclass(frozen=True, slots=True)
class Playbook:
    name: str
    contract: PlaybookContract
    body: str

    @property
    def tools(self) -> frozenset[str]:
        return frozenset(self.contract.composes_tools)

    @property
    def procedure(self) -> str:
        """What a planner reads."""
        return (
            f"Follow this procedure ({self.name}; it is for: {self.contract.trigger}).\n\n"
            f"{self.body.strip()}\n\n"
            f"It is done when: {self.contract.done_predicate}. "
            f"You have {self.contract.max_steps} steps."
        )

    def narrow(self, palette: Palette) -> Palette:
        """Return the palette with the tools of this playbook only.

        Raises ConfigError for a missing one.
        """
        missing = self.tools - palette.tools
        if missing:
            raise ConfigError(
                f"{self.name} composes {', '.join(sorted(missing))}, which is not provided here",
                hint=f"provided: {', '.join(sorted(palette.tools))}",
            )
        return dataclasses.replace(palette, only=self.tools)


def load_playbook(file: Path) -> Playbook:
    """Read a manifest of kind playbook and its text.

    Raises ManifestInvalid, and ConfigError for a missing text.
    """
    try:
        manifest = load_manifest(file)
    except ManifestError as error:
        raise ManifestInvalid(
            str(error), hint="`python -m vram_arbiter.schemas check FILE` shows every finding"
        ) from error
    contract = manifest.playbook
    if manifest.kind is not Kind.PLAYBOOK or contract is None:
        raise ManifestInvalid(f"{file}: {manifest.name} is a {manifest.kind}, not a playbook")
    unknown = [name for name in contract.composes_tools if name not in TOOLS]
    if unknown:
        raise ManifestInvalid(
            f"{file}: composes_tools: unknown tool {unknown[0]}",
            hint=f"choose from {', '.join(TOOLS)}",
        )
    return Playbook(manifest.name, contract, _body(file, contract.body_uri))


def _body(file: Path, uri: str) -> str:
    """Return the text from the manifest's own folder; nothing outside of it is read to a model."""
    folder = file.resolve().parent
    path = (folder / uri.removeprefix("local://")).resolve()
    if not path.is_relative_to(folder):
        raise ConfigError(f"{file}: body_uri: {uri} is outside of the playbook's folder")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{file}: body_uri: {path} cannot be read: {error.strerror}") from error
    if len(content) > BODY_MAX_BYTES:
        raise ConfigError(f"{file}: body_uri: {path} has more than {BODY_MAX_BYTES} bytes")
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        raise ConfigError(f"{file}: body_uri: {path} is not UTF-8 text") from error
