"""vLLM itself on a CPU, with bytes on the simulated GPU.

`python -m tests.support.vllm_server FOLDER BYTES PORT COMMAND...` becomes the command. A child
holds the bytes as long as it lives, but not while the metrics of the server on PORT say that it
sleeps: on a CPU vLLM says so, and has nothing to free.
"""

import os
import re
import sys
import time
import urllib.request
from pathlib import Path
from typing import Final

from tests.support.held_bytes import HeldBytes
from tests.support.tiny_gguf import TEMPLATE
from vram_arbiter.sidecars.parent import end_with

POLL_S: Final = 0.1
AWAKE: Final = re.compile(rb'^vllm:engine_sleep_state\{.*sleep_state="awake".*\} (.*)$', re.M)
CONTEXT: Final = 2048


def save_llama(folder: Path) -> None:
    """Save a language model of random weights, whose tokens are bytes."""
    import torch
    from transformers import LlamaConfig, LlamaForCausalLM

    from tests.sidecars.adapters.tiny_vision import chat_tokenizer

    tokenizer = chat_tokenizer(["<|endoftext|>", "<|im_end|>"])
    tokenizer.chat_template = TEMPLATE
    tokenizer.save_pretrained(folder)
    torch.manual_seed(0)
    config = LlamaConfig(
        vocab_size=len(tokenizer),
        hidden_size=64,
        intermediate_size=128,
        num_hidden_layers=2,
        num_attention_heads=2,
        max_position_embeddings=CONTEXT,
        eos_token_id=tokenizer.eos_token_id,
    )
    LlamaForCausalLM(config).save_pretrained(folder)


def hold(folder: str, size: str, port: str) -> None:
    """Hold the bytes while the server is awake. Never returns."""
    held, slept = HeldBytes(folder, size), False
    while True:
        time.sleep(POLL_S)
        try:
            # `/is_sleeping` asks the engine, and after that has ended keeps the server from ending
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as answer:
                awake = AWAKE.search(answer.read())
        except OSError:
            continue  # it does not listen yet, or not any more
        sleeps = awake is not None and not float(awake[1])
        if sleeps != slept:
            slept = sleeps
            (held.free if sleeps else held.load)()


def main(folder: str, size: str, port: str, *command: str) -> None:
    parent = os.getpid()
    if not os.fork():
        end_with(parent)
        hold(folder, size, port)
    os.execv(command[0], command)


if __name__ == "__main__":
    main(*sys.argv[1:])
