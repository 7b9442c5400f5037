"""Status and explanations as typed data."""
