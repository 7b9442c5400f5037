"""Queue, admission, victims, backfill, placement, deadlock."""
