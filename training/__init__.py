"""How the shipped models were made: scripts for a clone, which no program imports."""
