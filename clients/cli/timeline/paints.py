"""Colors of a timeline by the name of their paint, on a light and on a dark ground."""

_CONSUMERS = (
    ("#3d7ea6", "#5b9fc9"),
    ("#d1495b", "#e0707f"),
    ("#5b8c5a", "#7fb27d"),
    ("#d9952f", "#e3ac58"),
    ("#8a63a8", "#a986c4"),
    ("#3f9c98", "#63bbb7"),
    ("#a8703a", "#c49160"),
    ("#b85f8c", "#d184ab"),
)

_BOTH = {
    "queued": ("#f2c14e", "#d9a520"),
    "loading": ("#7fb7d9", "#4f8fb8"),
    "held": ("#a9b8a2", "#6f8268"),
    "use": ("#2f5d34", "#c6efca"),
    "revoke": ("#e8a0bf", "#b76d90"),
    "quiesce": ("#c86fa0", "#d58bb5"),
    "unload": ("#8f4fa8", "#b07cc6"),
    "verify": ("#4b3f8f", "#8f86d6"),
    "standby": ("#d6d6d6", "#55585e"),
    "parked": ("#b9c6d6", "#5f6f86"),
    "pressure": ("#f6d5d5", "#4d2a2c"),
    "measured": ("#111111", "#f5f5f5"),
    "loud": ("#c00000", "#ff7b72"),
    "text": ("#1c1c1e", "#e6e6e8"),
    "faint": ("#5c6066", "#a3a7ad"),
    "grid": ("#e2e4e8", "#33363c"),
    "frame": ("#f7f8fa", "#1d1f23"),
    "ground": ("#ffffff", "#151619"),
}

LIGHT = {f"c{at}": light for at, (light, _) in enumerate(_CONSUMERS)} | {
    name: light for name, (light, _) in _BOTH.items()
}
DARK = {f"c{at}": dark for at, (_, dark) in enumerate(_CONSUMERS)} | {
    name: dark for name, (_, dark) in _BOTH.items()
}
