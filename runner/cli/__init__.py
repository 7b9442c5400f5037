"""Command line of the runner, one module per command."""

import argparse

type Commands = argparse._SubParsersAction[argparse.ArgumentParser]
"""To which a command's module adds its parser."""
