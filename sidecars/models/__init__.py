"""Model classes of the small shipped checkpoints."""
