"""Was the memory returned? Schedule, evidence, judge."""
