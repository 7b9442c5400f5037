"""The status page: one read-only page for a browser, its live events, and access of clients."""
