"""Model classes of our own small checkpoints."""
