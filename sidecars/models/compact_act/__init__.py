"""A small action-chunking policy in lerobot's own plug-in form: type `compact_act`.

Importing this package registers the type; a checkpoint of it then loads like a hub checkpoint of
ACT or SmolVLA: `PreTrainedConfig.from_pretrained`, `get_policy_class`, `make_pre_post_processors`.
lerobot's stock policies have a 45 MB backbone, too much for a checkpoint that ships with the
source. Module and class names follow lerobot's convention (`configuration_`, `modeling_`,
`processor_`), which its factory relies on.
"""

from vram_arbiter.sidecars.models.compact_act.configuration_compact_act import CompactActConfig

__all__ = ["CompactActConfig"]
