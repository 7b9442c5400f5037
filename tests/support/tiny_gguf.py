"""A language model of 115,392 random weights as GGUF, whose tokens are bytes."""

from pathlib import Path
from typing import Final

import numpy as np

WIDTH: Final = 64
LAYERS: Final = 2
HEADS: Final = 4
CONTEXT: Final = 4096
SPECIAL: Final = ("<unk>", "<s>", "</s>")
TEMPLATE: Final = "{% for message in messages %}{{ message.content }}\n{% endfor %}"


def write_gguf(path: Path) -> None:
    from gguf import GGUFWriter, TokenType

    writer = GGUFWriter(path, "llama")
    writer.add_context_length(CONTEXT)
    writer.add_embedding_length(WIDTH)
    writer.add_block_count(LAYERS)
    writer.add_feed_forward_length(2 * WIDTH)
    writer.add_head_count(HEADS)
    writer.add_layer_norm_rms_eps(1e-5)
    tokens = [*SPECIAL, *(f"<0x{byte:02X}>" for byte in range(256))]
    kinds = [TokenType.UNKNOWN, TokenType.CONTROL, TokenType.CONTROL, *[TokenType.BYTE] * 256]
    writer.add_tokenizer_model("llama")
    writer.add_token_list(tokens)
    writer.add_token_scores([0.0] * len(tokens))
    writer.add_token_types(kinds)
    writer.add_unk_token_id(0)
    writer.add_bos_token_id(1)
    writer.add_eos_token_id(2)
    writer.add_chat_template(TEMPLATE)
    random = np.random.default_rng(0)
    for name, shape in _shapes(len(tokens)).items():
        weights = random.normal(0, 0.05, shape) if len(shape) > 1 else np.ones(shape)
        writer.add_tensor(f"{name}.weight", weights.astype(np.float32))
    writer.write_header_to_file()
    writer.write_kv_data_to_file()
    writer.write_tensors_to_file()
    writer.close()


def _shapes(tokens: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of each tensor by its name."""
    square, up, down = (WIDTH, WIDTH), (2 * WIDTH, WIDTH), (WIDTH, 2 * WIDTH)
    one: dict[str, tuple[int, ...]] = {
        **{f"attn_{part}": square for part in ("q", "k", "v", "output")},
        "attn_norm": (WIDTH,),
        "ffn_norm": (WIDTH,),
        "ffn_gate": up,
        "ffn_up": up,
        "ffn_down": down,
    }
    layers = {
        f"blk.{layer}.{name}": shape for layer in range(LAYERS) for name, shape in one.items()
    }
    ends = {"token_embd": (tokens, WIDTH), "output_norm": (WIDTH,), "output": (tokens, WIDTH)}
    return {**ends, **layers}
