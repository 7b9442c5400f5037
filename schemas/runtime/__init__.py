"""Plumbing that every program shares: servers, framing, decoding. Contracts and the core never
import it."""
