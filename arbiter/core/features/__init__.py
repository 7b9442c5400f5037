"""Optional features behind walls."""
