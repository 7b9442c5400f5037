"""Scripts that make the small models which the demo ships; nothing at run time imports this folder."""
