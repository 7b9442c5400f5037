"""Scripts that train the demo's small models; nothing at run time imports this folder."""
