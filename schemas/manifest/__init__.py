"""rSkill manifests: the field's `rskill.yaml` files, read unchanged and checked field by field."""

from vram_arbiter.schemas.findings import Problem
from vram_arbiter.schemas.manifest.load import ManifestError, load_manifest, parse_manifest
from vram_arbiter.schemas.manifest.manifest import LICENSE_FLAG, LICENSE_HELP, RSkillManifest
from vram_arbiter.schemas.manifest.vocabulary import Kind, License, ModelFamily, Role, SkillAction

__all__ = [
    "LICENSE_FLAG",
    "LICENSE_HELP",
    "Kind",
    "License",
    "ManifestError",
    "ModelFamily",
    "Problem",
    "RSkillManifest",
    "Role",
    "SkillAction",
    "load_manifest",
    "parse_manifest",
]
