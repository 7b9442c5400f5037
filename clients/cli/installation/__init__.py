"""`vramctl install` and `uninstall`: a plan of steps, their effects, and what was installed."""
