"""What each kind of rSkill must, may and must not say: one table, and the function that applies it.

Works on plain values, so that the same rules judge a half-written file and a finished manifest.
"""

from vram_arbiter.schemas.findings import Problem
from vram_arbiter.schemas.manifest.vocabulary import PROCESSOR_FAMILIES, Kind
from vram_arbiter.schemas.plain import JsonMap

KINDS = tuple(Kind)

_TABLE = """
field               vla  wam  ros_action ros_service detector segmenter vlm  reward playbook
weights_uri         R    -    F          F           R        R         R    R      F
model_family        R    -    F          F           F        F         -    F      F
ros_integration     F    -    R          R           F        F         F    F      F
detector            F    -    F          F           R        F         F    F      F
segmenter           F    -    F          F           F        R         F    F      F
reward              F    -    F          F           F        F         F    R      F
playbook            F    F    F          F           F        F         F    F      R
action_contract     -    -    F          F           F        F         F    F      F
state_contract      -    -    F          F           F        F         F    F      F
processors          -    -    F          F           F        F         F    F      F
n_action_steps      -    -    F          F           F        F         F    F      F
starting_pose       -    -    F          F           F        F         F    F      F
image_preprocessing -    -    F          F           -        F         F    F      F
reward_rskill_name  -    F    F          F           F        F         F    F      F
min_vram_gb         -    -    -          -           -        -         -    -      F
envelope            -    -    -          -           -        -         -    -      F
environment         -    -    F          F           -        -         -    -      F
actuators_required  R    -    R          R           F        F         F    F      F
chunk_size          -    -    =1         =1          -        -         -    -      =1
role                -    -    -          -           -        -         -    -      =s2
actions             -    -    -          -           -        -         -    -      +plan
"""


def _read(table: str) -> dict[str, dict[Kind, str]]:
    head, *lines = table.strip().splitlines()
    kinds = [Kind(name) for name in head.split()[1:]]
    rows = (line.split() for line in lines)
    return {field: dict(zip(kinds, cells, strict=True)) for field, *cells in rows}


RULES: dict[str, dict[Kind, str]] = _read(_TABLE)
"""field → kind → `R` required, `F` forbidden, `-` free, `=v` must be v, `+v` must contain v. An
empty list counts as not given."""

_WHY = {
    "chunk_size": "every row must pass the safety check by itself",
    "role": "a playbook is read by the slow reasoner",
    "actions": "a playbook plans",
}


def check_kind(kind: Kind, values: JsonMap) -> list[Problem]:
    """Findings of the table, and of the families that need processors; `values` maps field names to
    raw or validated values."""
    problems = []
    for field, row in RULES.items():
        rule, value = row[kind], values.get(field)
        given = value is not None and value != [] and value != ()
        message = ""
        if rule == "R" and not given:
            message = f"is required for kind {kind.value!r}"
        elif rule == "F" and given:
            message = f"is not allowed for kind {kind.value!r}; remove it"
        elif rule[0] == "=" and field in values and str(value) != rule[1:]:
            message = f"must be {rule[1:]} for kind {kind.value!r}, not {value}: {_WHY[field]}"
        elif (
            rule[0] == "+"
            and isinstance(value, list | tuple)
            and rule[1:] not in [str(word) for word in value]
        ):
            message = f"must contain {rule[1:]!r} for kind {kind.value!r}: {_WHY[field]}"
        if message:
            problems.append(Problem((field,), message))
    family = values.get("model_family")
    wanted = isinstance(family, str) and family in PROCESSOR_FAMILIES
    if RULES["processors"][kind] != "F" and wanted and values.get("processors") is None:
        problems.append(Problem(("processors",), f"is required for model_family {str(family)!r}"))
    return problems
