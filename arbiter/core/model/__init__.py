"""Records of the engine."""
